"""Learn a servo from one record, and simulate another one, with force pulses, from its first row.

The machine is that of Janot, Gautier and Brunot (2019). Its files hold the position as
(x - 0.125 m) / 0.125 m and the control signal in V, of which the drive makes 35.15065 N each.
``force`` of the files adds the pulses to a signal that has them already, and is not used.

Tried before the first run, by what half of the estimation record says of the other half: steps of
25, 50 and 100 ms, 60 to 490 transitions, learning from draws or from means, friction with a slope
of its own in each direction (it was not better). Seen of the validation record by then: errors of
f_p with some sets of parameters, 4.9 to 9.0 mm, and a regression of its force; no GP's.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, FunctionPhysics, PhysicsMeanGP, Unknown, ZeroMeanGP
from gpadjust.core import SamplingWarning
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import ParameterValues
from gpadjust.records import Record, Records, SmoothedRecords, SmoothingWarning, smooth
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import markdown, number
from paper.common.verdicts import Difference
from paper.published import EMPS_GPS, Emps, EmpsSettings

DATA = Path(__file__).parent / "data" / "emps"
_SAMPLING = 0.005  # s
_NEWTON = 35.15065  # of a volt
_STROKE = 0.125  # m
_SUBSTEPS = 5
_START = {"v": (0.0, 0.01)}  # m/s: both records begin at rest
_HELD = (1e-6, 1e-5)  # process noise of q in m and of v in m/s
_UNKNOWNS = {
    "M": Unknown(100.0, factor=1.5, unit="kg"),
    "Fv": Unknown(200.0, factor=1.5, unit="N s/m"),
    "Fc": Unknown(20.0, factor=1.5, unit="N"),
    "c": Unknown(0.0, sd=5.0, unit="N"),
}
AUTHORS = {
    "M": (95.1089, 0.1085),
    "Fv": (203.5034, 1.1460),
    "Fc": (20.3935, 0.1012),
    "c": (-3.1648, 0.0444),
}
"""Least squares of the authors with their standard deviations (EMPS_Description.pdf, page 4)."""
PUBLISHED = {
    "GRU": (220.3, "2405.10779"),
    "MLP, finite impulse response": (120.8, "2405.10779"),
    "OLSTM": (110.9, "2405.10779"),
    "recurrent network": (89.2, "2405.10779"),
    "LSTM": (74.1, "2405.10779"),
    "state space, ARX, three NARX": (None, "2405.10779"),
    "dynoNet, not tuned": (5.01, "benchmark sheet of 2024"),
    "dynoNet": (2.64, "2006.02250"),
}
"""Errors in mm of simulations of the validation record; None was not found.

Those of 2405.10779 are from the result files of its authors (MDCHAMP/nonlinear_baselines, 73d8445).
"""
_MODELS = {"delta": PhysicsMeanGP, "cka": CKA, "gp": ZeroMeanGP}


class Part(NamedTuple):
    """A part of a record: forces are means over a step, in N, positions in m."""

    q: Tensor
    force: Tensor
    step: float

    @property
    def spec(self) -> StateSpec:
        """Position and velocity, of which models predict the latter alone."""
        return StateSpec(["q", "v"], ["force"], step=self.step, integrated={"q": "v"})

    def records(self) -> Records:
        """A record without velocities."""
        states = torch.stack([self.q, torch.full_like(self.q, torch.nan)], dim=-1)
        times = self.step * torch.arange(len(self.q), dtype=torch.float64)
        return Records([Record(times, states, self.force.unsqueeze(-1), name="servo")], self.spec)

    def halves(self) -> tuple[Part, Part]:
        """The first half, and the second from the last row of the first."""
        half = len(self.q) // 2
        return (
            self._replace(q=self.q[:half], force=self.force[:half]),
            self._replace(q=self.q[half - 1 :], force=self.force[half - 1 :]),
        )


def measured(name: str, settings: EmpsSettings) -> Part:
    """A record, in steps of ``every`` rows; between rows the force is linear."""
    file = pd.read_csv(DATA / f"{name}.csv")[: settings.rows]
    q, volts = (torch.from_numpy(file[c].to_numpy(copy=True)) for c in ("q", "force_in"))
    force = _NEWTON * torch.cat([(volts[1:] + volts[:-1]) / 2, volts[-1:]])
    steps = len(q) // settings.every
    each = force[: steps * settings.every].view(steps, settings.every).mean(1)
    places = (_STROKE * (1 + q))[: steps * settings.every : settings.every]
    return Part(places, each, _SAMPLING * settings.every)


def physics(step: float, values: Sequence[float] | None = None) -> FunctionPhysics:
    r"""The next position and velocity, with unknown parameters or these.

    :math:`M q'' = F - F_v q' - F_c \operatorname{sign} q' - c` (Janot et al. 2019). Dry friction
    decelerates, or holds what it has stopped, in each of five substeps.
    """
    h = step / _SUBSTEPS

    def following(X: Tensor, p: ParameterValues) -> Tensor:
        q, v, force = X.unbind(-1)
        for _ in range(_SUBSTEPS):
            free = v + h * (force - p.Fv * v - p.c) / p.M
            slower = free.sign() * (free.abs() - h * p.Fc / p.M).clamp_min(0.0)
            q, v = q + h * (v + slower) / 2, slower
        return torch.stack([q, v], dim=-1)

    if values is None:
        return FunctionPhysics(following, unknowns=_UNKNOWNS, name="servo")
    known = ParameterValues(tuple(_UNKNOWNS), torch.tensor(values, dtype=torch.float64))
    return FunctionPhysics(lambda X: following(X, known), name="servo")


@cache
def smoothed(name: str, half: bool, held: bool, settings: EmpsSettings) -> SmoothedRecords:
    """States and parameters by a record, or by its first half."""
    part = measured(name, settings)
    part = part.halves()[0] if half else part
    noise = torch.tensor(_HELD, dtype=torch.float64) if held else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        return smooth(
            part.records(),
            physics(part.step),
            start=_START,
            process_noise=noise,
            num_starts=1,
            max_rounds=settings.rounds,
        )


def run(experiment: Emps, learner: str, seed: int) -> Run:
    """Learn from the estimation record, simulate the validation record; the same of its halves."""
    warnings.simplefilter("ignore", SamplingWarning)
    settings = experiment.settings
    estimation, validation = (measured(n, settings) for n in ("estimation", "validation"))
    begin = time.perf_counter()
    found = _simulated(learner, seed, False, 0.0, validation, settings)
    found["seconds"] = time.perf_counter() - begin
    if learner == "authors":
        return found
    states = smoothed("estimation", True, learner == "held", settings).records.records[0].states
    half = _simulated(learner, seed, True, float(states[-1, 1]), estimation.halves()[1], settings)
    found["halves"] = half["rmse"]
    if learner in ("fitted", "held"):
        for name in ("estimation", "validation"):
            of = smoothed(name, False, learner == "held", settings).physics_parameters
            found[name] = torch.stack([of.mean, *of.interval()]).T.tolist()
    if learner == "fitted":
        found["lacking"] = _lacking(settings)
    return found


def _simulated(
    learner: str, seed: int, half: bool, v: float, part: Part, settings: EmpsSettings
) -> Run:
    """Scores of a free run along a part, in mm, from its first position and this velocity."""
    given: dict[str, Any] = {"num_functions": settings.num_functions, "noise": False}
    if learner == "authors":
        values = [mean for mean, _ in AUTHORS.values()]
        dynamics: Dynamics = PhysicsDynamics(part.spec, physics(part.step, values))
    else:
        known = smoothed("estimation", half, learner == "held", settings)
        f_p = physics(part.step, known.physics_parameters.mean.tolist())
        dynamics = PhysicsDynamics(part.spec, f_p)
        given |= {"noise": known.noise.nan_to_num(), "process_noise": known.process_noise}
        if learner in EMPS_GPS:
            f_p_or_none = None if learner == "gp" else f_p
            learnt = LearnedDynamics(part.spec, f_p_or_none, model=_MODELS[learner])
            learnt.update(*known.draw(seed).trajectories())
            dynamics, given["process_noise"] = learnt, "learnt"
    start = torch.tensor([[float(part.q[0]), v]], dtype=torch.float64)
    free = dynamics.free_run(start, part.force[None, :-1, None], **given)
    off, low, high = (
        1e3 * (each[0, :, 0] - part.q[1:]) for each in (free.mean, free.lower, free.upper)
    )
    inside = ((low <= 0) & (high >= 0)).double().mean()
    kept = {"off": off, "low": low, "high": high}
    return {
        "rmse": float(off.square().mean().sqrt()),
        "most": float(off.abs().max()),
        "coverage": None if learner == "authors" else float(inside),
        "half_width": None if learner == "authors" else float((high - low).mean() / 2),
        "path": {name: [round(x, 3) for x in each[3::4].tolist()] for name, each in kept.items()},
    }


def _lacking(settings: EmpsSettings) -> Run:
    """Velocities of the smoothed estimation record, and the force that f_p lacks there, in N."""
    known = smoothed("estimation", False, False, settings)
    part, values = measured("estimation", settings), known.physics_parameters.mean.tolist()
    states = known.records.records[0].states
    following = physics(part.step, values)(torch.cat([states, part.force[:, None]], -1))[:-1]
    force = values[0] * (states[1:, 1] - following[:, 1]) / part.step
    smooth_force = force.unfold(0, 9, 1).mean(-1)  # over 0.2 s, as single steps are noise
    middle = states[5:-4, 1] if len(states) > 9 else states[:0, 1]
    rows = slice(None, None, 2)
    return {
        "v": [round(x, 4) for x in middle[rows].tolist()],
        "force": [round(x, 2) for x in smooth_force[rows].tolist()],
    }


def tables(runs: Sequence[Run], experiment: Emps) -> dict[str, Table]:
    """All tables, by name."""
    return {
        "learners": Table("Simulation of the validation record", _learners(runs, experiment)),
        "parameters": Table("The four unknowns", _parameters(runs)),
    }


def _of(runs: Sequence[Run], learner: str) -> list[Run]:
    return [each for each in runs if each["learner"] == learner]


def chosen(runs: Sequence[Run]) -> str:
    """The learner that errs least from half to half of the estimation record, in the mean."""
    errors = {
        name: float(np.mean([each["halves"] for each in own]))
        for name in ("fitted", "held", *EMPS_GPS)
        if (own := _of(runs, name))
    }
    return min(errors, key=lambda name: errors[name])


def _learners(runs: Sequence[Run], experiment: Emps) -> str:
    best, rows = chosen(runs), []
    for learner, label in experiment.axes["learner"].items():
        if not (own := _of(runs, learner)):
            continue
        columns = [
            [each.get(name) for each in own]
            for name in ("rmse", "most", "coverage", "half_width", "halves", "seconds")
        ]
        numbers = [[x for x in column if x is not None] for column in columns]
        forms = (".2f", ".1f", ".2f", ".1f", ".2f", ".0f")
        cells = [_mean(x, form) for x, form in zip(numbers, forms, strict=True)]
        text = f"**{label}**" if learner == best else label
        rows.append([text, f"{len(own)}", cells[0], f"{max(numbers[0]):.2f}", *cells[1:]])
        if len(own) > 1:  # the states are not known: free runs of all that they may be
            off = np.mean([each["path"]["off"] for each in own], axis=0)
            pooled = number(float(np.sqrt(np.mean(off**2))), ".2f")
            rows.append([f"{label}, mean path of all runs", "", pooled, *[""] * 6])
    for name, (error, source) in PUBLISHED.items():
        shown = "not found" if error is None else number(error)
        rows.append([f"{name}, {source}", "", shown, "", "", "", "", "", ""])
    header = ["", "runs", "RMSE, mm", "worst run, mm", "most in a run, mm", "95 % hold"]
    header += ["half width of 95 %, mm", "RMSE from half to half, mm", "seconds"]
    return markdown(header, rows)


def _mean(values: Sequence[float], form: str) -> str:
    """The mean, with its standard error if there are several."""
    found = Difference.of(values)
    error = "" if np.isnan(found.error) else f" ± {found.error:{form}}"
    return number(found.mean, form) + error


def _parameters(runs: Sequence[Run]) -> str:
    """The four unknowns by the authors and by the smoothers, with intervals of 95 %."""
    columns = {"the authors' least squares": [(m, m - 1.96 * s, m + 1.96 * s) for m, s in
                                              AUTHORS.values()]}  # fmt: skip
    for learner, label in (("fitted", "smoothed"), ("held", "smoothed, little process noise")):
        for own in _of(runs, learner)[:1]:
            columns[label] = own["estimation"]
            columns[f"{label}, validation record"] = own["validation"]
    rows = [
        [f"{name}, {known.unit}", *(_interval(*column[i]) for column in columns.values())]
        for i, (name, known) in enumerate(_UNKNOWNS.items())
    ]
    return markdown(["", *columns], rows)


def _interval(mean: float, low: float, high: float) -> str:
    form = ".2f" if abs(mean) < 50 else ".1f"
    return f"{mean:{form}} ({low:{form}} to {high:{form}})"


def draw(runs: Sequence[Run], experiment: Emps) -> list[Path]:
    """Draw errors of the free runs, and the force that f_p lacks."""
    best, step = chosen(runs), _SAMPLING * experiment.settings.every
    labels = experiment.axes["learner"]
    shown = [n for n in dict.fromkeys(("fitted", best if best in EMPS_GPS else "cka"))
             if _of(runs, n)]  # fmt: skip
    titles = [f"{labels[name]}, a run" for name in shown]
    figure, axes = panels([*titles, "what f_p lacks, estimation record"], 3, (4.0, 3.2),
                          share=False)  # fmt: skip
    for ax, name in zip(axes, shown, strict=False):
        path = _of(runs, name)[0]["path"]
        seconds = step * (4 + 4 * np.arange(len(path["off"])))
        ax.fill_between(seconds, path["low"], path["high"], color="tab:blue", alpha=0.25, lw=0)
        ax.plot(seconds, path["off"], color="tab:blue")
        ax.axhline(0.0, color="black", lw=0.8)
        ax.set(xlabel="s", ylabel="simulated less measured position, mm")
    limit = max(ax.get_ylim()[1] for ax in axes[: len(shown)])
    for ax in axes[: len(shown)]:
        ax.set_ylim(-limit, limit)
    for own in _of(runs, "fitted")[:1]:
        axes[-1].plot(own["lacking"]["v"], own["lacking"]["force"], ".", ms=2, color="0.3")
        axes[-1].axhline(0.0, color="black", lw=0.8)
        axes[-1].set(xlabel="velocity, m/s", ylabel="force, N", ylim=(-8, 8))
    return [save(figure, experiment.out / "emps.png")]
