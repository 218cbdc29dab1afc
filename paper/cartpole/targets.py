"""What the library set itself in this experiment, each with the number that decides it."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from gpadjust.envs.cart_pole import TIME_STEP
from paper.cartpole.scenarios import SCENARIOS, SETTINGS
from paper.control.claims import Claim, Verdict, judged, num_runs
from paper.control.results import PARTS, curve, first_below, window

TARGETS = {
    "T1": ("Dyna-CKA's mean cost is at most 0.5 at trial 6 or before", ("cka",)),
    "T2": ("Dyna-CKA's mean cost is at most 0.40 over trials 13-25", ("cka",)),
    "T3": ("Dyna-CKA's mean cost is at most 0.40 over trials 41-50", ("cka",)),
    "T4": ("Dyna-CKA's fits and model steps take no longer than SAC's updates", ("cka",)),
    "T5": ("a run of Dyna-CKA with 1 update a step takes less than 120 s", ("cka-1",)),
    "T6": (
        "with the best number of updates, Dyna-CKA's mean cost stays at most 0.5 from trial 7 "
        "(PILCO's published figure: about 7 trials, 17.5 s) to 25",
        ("cka", "cka-1", "cka-4"),
    ),
}
_SECONDS = SETTINGS.trial_length * TIME_STEP


@dataclass(frozen=True)
class Targets:
    """Judges the targets by the mean over runs; an ± is a standard error.

    T6 takes the best of three settings on the seeds that it reports; all three are said. T4 and T5
    are the same for either measure.

    Args:
        trials: The records, see :func:`~paper.cartpole.results.load`.
        measure: ``"cost"`` of the trials as sampled, or ``"evaluation"`` of the deterministic
            policy.
    """

    trials: pd.DataFrame
    measure: str

    def judge(self) -> list[Claim]:
        """All targets; one that needs what was not run to its end is not judged."""
        full = set(self.trials[self.trials["trial"] == SETTINGS.num_trials]["scenario"])
        return judged(TARGETS, full, self._decide)

    def _decide(self, name: str) -> tuple[Verdict, str]:
        met, measured = getattr(self, f"_{name.lower()}")()
        return ("met" if met else "missed"), measured

    def _t1(self) -> tuple[bool, str]:
        by_trial = curve(self.trials, "cka", self.measure)
        first = first_below(by_trial, 0.5)
        reached = "never" if first is None else f"at trial {first}"
        return first is not None and first <= 6, f"{reached}; at 6 {self._window('cka', 6, 6)}"

    def _t2(self) -> tuple[bool, str]:
        return self._at_most(0.4, 13, 25)

    def _t3(self) -> tuple[bool, str]:
        return self._at_most(0.4, 41, 50)

    def _t4(self) -> tuple[bool, str]:
        fit, rollout, sac = self._seconds("cka")
        late = self._ratio("cka", first=SETTINGS.model_until - 4)
        measured = (
            f"{(fit + rollout) / sac:.2f} of it (fits {fit:.0f} s, model steps {rollout:.0f} s, "
            f"updates {sac:.0f} s); in trials {SETTINGS.model_until - 4}-{SETTINGS.model_until} "
            f"{late:.2f}"
        )
        if (self.trials["scenario"] == "cka-1").any():
            measured += (
                f"; with 1 update a step {self._ratio('cka-1'):.2f}, in those trials "
                f"{self._ratio('cka-1', first=SETTINGS.model_until - 4):.2f}"
            )
        return fit + rollout <= sac, measured

    def _t5(self) -> tuple[bool, str]:
        seconds = sum(self._seconds("cka-1"))
        return seconds < 120, f"{seconds:.0f} s ({num_runs(self.trials, 'cka-1')})"

    def _t6(self) -> tuple[bool, str]:
        found = {name: self._stays_from(name) for name in TARGETS["T6"][1]}
        parts = [
            f"{SCENARIOS[name].label}: "
            + ("never" if first is None else f"from trial {first} ({first * _SECONDS:.1f} s)")
            + f" ({num_runs(self.trials, name)})"
            for name, first in found.items()
        ]
        return any(first is not None and first <= 7 for first in found.values()), "; ".join(parts)

    def _at_most(self, threshold: float, first: int, last: int) -> tuple[bool, str]:
        mean = window(self.trials, "cka", self.measure, first, last).mean()
        return bool(mean <= threshold), self._window("cka", first, last)

    def _window(self, name: str, first: int, last: int) -> str:
        costs = window(self.trials, name, self.measure, first, last)
        error = f" ± {costs.sem():.3f}" if len(costs) > 1 else ""
        return (
            f"{costs.mean():.3f}{error}, the worst run {costs.max():.3f} "
            f"({num_runs(self.trials, name)})"
        )

    def _stays_from(self, name: str) -> int | None:
        """The first trial from which every trial's mean cost until model_until is at most 0.5."""
        by_trial = curve(self.trials, name, self.measure).loc[: SETTINGS.model_until]
        above = by_trial.index[by_trial > 0.5]
        first = int(above[-1]) + 1 if len(above) else 1
        return first if first <= SETTINGS.model_until else None

    def _seconds(self, name: str, first: int = 1, last: int = SETTINGS.num_trials) -> list[float]:
        """Mean seconds of a run in fits, model steps and updates."""
        chosen = self.trials[
            (self.trials["scenario"] == name) & self.trials["trial"].between(first, last)
        ]
        by_run = chosen.groupby("seed")[[f"{part}_seconds" for part in PARTS]].sum()
        return [float(seconds) for seconds in by_run.mean()]

    def _ratio(self, name: str, first: int = 1) -> float:
        """Seconds of fits and model steps over those of updates; from a trial while it is used."""
        last = SETTINGS.num_trials if first == 1 else SETTINGS.model_until
        fit, rollout, sac = self._seconds(name, first, last)
        return (fit + rollout) / sac
