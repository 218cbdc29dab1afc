"""What the library set itself in this experiment, each with the number that decides it.

By the mean over runs; an ± is a standard error. T6 takes the best of three settings on the seeds
that it reports; all three are said. T4 and T5 are the same for either measure.
"""

from __future__ import annotations

from gpadjust.envs.cart_pole import TIME_STEP
from paper.cartpole.scenarios import SCENARIOS, SETTINGS
from paper.control.claims import Claim, Finding, met, reached
from paper.control.curves import Curves
from paper.control.results import PARTS, seconds_of_a_run

_SECONDS = SETTINGS.trial_length * TIME_STEP
_LATE = SETTINGS.model_until - 4  # the first of the last five trials in which the model serves


def _soon(curves: Curves) -> Finding:
    first = curves.first("cka", 0.5)
    return met(first is not None and first <= 6), f"{reached(first)}; at 6 {_costs(curves, 6, 6)}"


def _while_it_serves(curves: Curves) -> Finding:
    return _at_most(curves, 0.4, 13, 25)


def _at_the_end(curves: Curves) -> Finding:
    return _at_most(curves, 0.4, 41, 50)


def _cheap(curves: Curves) -> Finding:
    fit, rollout, sac = _seconds(curves, "cka")
    measured = (
        f"{(fit + rollout) / sac:.2f} of it (fits {fit:.0f} s, model steps {rollout:.0f} s, "
        f"updates {sac:.0f} s); in trials {_LATE}-{SETTINGS.model_until} {_late(curves, 'cka'):.2f}"
    )
    if curves.seeds("cka-1", SETTINGS.num_trials):
        few = _seconds(curves, "cka-1")
        measured += (
            f"; with 1 update a step {(few[0] + few[1]) / few[2]:.2f}, in those trials "
            f"{_late(curves, 'cka-1'):.2f}"
        )
    return met(fit + rollout <= sac), measured


def _fast(curves: Curves) -> Finding:
    seconds = sum(_seconds(curves, "cka-1"))
    return met(seconds < 120), f"{seconds:.0f} s"


def _few_trials(curves: Curves) -> Finding:
    found = {name: _stays_from(curves, name) for name in ("cka", "cka-1", "cka-4")}
    parts = [
        f"{SCENARIOS[name].label}: "
        + ("never" if first is None else f"from trial {first} ({first * _SECONDS:.1f} s)")
        for name, first in found.items()
    ]
    return met(any(first is not None and first <= 7 for first in found.values())), "; ".join(parts)


TARGETS = (
    Claim("T1", "Dyna-CKA's mean cost is at most 0.5 at trial 6 or before", ("cka",), _soon),
    Claim(
        "T2", "Dyna-CKA's mean cost is at most 0.40 over trials 13-25", ("cka",), _while_it_serves
    ),
    Claim("T3", "Dyna-CKA's mean cost is at most 0.40 over trials 41-50", ("cka",), _at_the_end),
    Claim(
        "T4", "Dyna-CKA's fits and model steps take no longer than SAC's updates", ("cka",), _cheap
    ),
    Claim(
        "T5",
        "fits, model steps and updates of Dyna-CKA with 1 update a step take less than 120 s",
        ("cka-1",),
        _fast,
    ),
    Claim(
        "T6",
        "with the best number of updates, Dyna-CKA's mean cost stays at most 0.5 from trial 7 "
        "(PILCO's published figure: about 7 trials, 17.5 s) to 25",
        ("cka", "cka-1", "cka-4"),
        _few_trials,
    ),
)


def _at_most(curves: Curves, threshold: float, first: int, last: int) -> Finding:
    mean = float(curves.window("cka", first, last).mean())
    return met(mean <= threshold), _costs(curves, first, last)


def _costs(curves: Curves, first: int, last: int) -> str:
    costs = curves.window("cka", first, last)
    return f"{costs.mean():.3f} ± {costs.sem():.3f}, the worst run {costs.max():.3f}"


def _stays_from(curves: Curves, name: str) -> int | None:
    """The first trial from which every trial's mean cost until model_until is at most 0.5."""
    by_trial = curves.mean(name).loc[: SETTINGS.model_until]
    above = by_trial.index[by_trial > 0.5]
    first = int(above[-1]) + 1 if len(above) else 1
    return first if first <= SETTINGS.model_until else None


def _seconds(
    curves: Curves, name: str, first: int = 1, last: int = SETTINGS.num_trials
) -> list[float]:
    """Median seconds of a run in fits, model steps and updates."""
    chosen = curves.records[
        (curves.records["scenario"] == name) & curves.records["trial"].between(first, last)
    ]
    return [float(seconds) for seconds in seconds_of_a_run(chosen, PARTS).loc[name]]


def _late(curves: Curves, name: str) -> float:
    """Seconds of fits and model steps over those of updates, in the model's last trials."""
    fit, rollout, sac = _seconds(curves, name, _LATE, SETTINGS.model_until)
    return (fit + rollout) / sac
