"""Learn a servo from one record, and simulate another one, with force pulses, from its first row.

The machine is that of Janot, Gautier and Brunot (2019). Its files hold the position as
(x - 0.125 m) / 0.125 m and the control signal in V, of which the drive makes 35.15065 N each.
``force`` of the files adds the pulses to a signal that has them already, and is not used.

Steps, transitions and draws were chosen by halves of the estimation record, before the first run of
an earlier experiment (``earlier.md``).
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
from paper.common.tables import Cell, frame, groups, markdown, number, of, table, with_rows
from paper.common.verdicts import Difference
from paper.published import Emps

DATA = Path(__file__).parent / "data" / "emps"
_SAMPLING = 0.005  # s
_NEWTON = 35.15065  # of a volt
_STROKE = 0.125  # m
_SUBSTEPS = 5
_START = {"v": (0.0, 0.01)}  # m/s: both records begin at rest
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
    "dynoNet, not tuned": (5.01, "benchmark sheet of 2024"),
    "dynoNet": (2.64, "2006.02250"),
}
"""Errors in mm of simulations of the validation record.

Those of 2405.10779 are from the result files of its authors (MDCHAMP/nonlinear_baselines,
73d8445), which lack five others.
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


def measured(name: str, experiment: Emps) -> Part:
    """A record, in steps of ``every`` rows; between rows the force is linear."""
    file = pd.read_csv(DATA / f"{name}.csv")[: experiment.rows]
    q, volts = (torch.from_numpy(file[c].to_numpy(copy=True)) for c in ("q", "force_in"))
    force = _NEWTON * torch.cat([(volts[1:] + volts[:-1]) / 2, volts[-1:]])
    steps = len(q) // experiment.every
    each = force[: steps * experiment.every].view(steps, experiment.every).mean(1)
    places = (_STROKE * (1 + q))[: steps * experiment.every : experiment.every]
    return Part(places, each, _SAMPLING * experiment.every)


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
def smoothed(experiment: Emps) -> SmoothedRecords:
    """States and parameters by the estimation record."""
    part = measured("estimation", experiment)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        return smooth(
            part.records(),
            physics(part.step),
            start=_START,
            num_starts=1,
            max_rounds=experiment.rounds,
        )


def run(experiment: Emps, learner: str, seed: int) -> Run:
    """Learn from the estimation record; return the errors in mm of a free run along the other."""
    warnings.simplefilter("ignore", SamplingWarning)
    part, begin = measured("validation", experiment), time.perf_counter()
    given: dict[str, Any] = {"num_functions": experiment.num_functions, "noise": False}
    parameters = None
    if learner == "authors":
        values = [mean for mean, _ in AUTHORS.values()]
        dynamics: Dynamics = PhysicsDynamics(part.spec, physics(part.step, values))
    else:
        known = smoothed(experiment)
        found = known.physics_parameters
        parameters = torch.stack([found.mean, *found.interval()]).T.tolist()
        f_p = physics(part.step, found.mean.tolist())
        dynamics = PhysicsDynamics(part.spec, f_p)
        given |= {"noise": known.noise.nan_to_num(), "process_noise": known.process_noise}
        if learner in _MODELS:
            known_or_none = None if learner == "gp" else f_p
            learnt = LearnedDynamics(part.spec, known_or_none, model=_MODELS[learner])
            learnt.update(*known.draw(seed).trajectories())
            dynamics, given["process_noise"] = learnt, "learnt"
    start = torch.tensor([[float(part.q[0]), 0.0]], dtype=torch.float64)
    free = dynamics.free_run(start, part.force[None, :-1, None], **given)
    off, low, high = (
        1e3 * (each[0, :, 0] - part.q[1:]) for each in (free.mean, free.lower, free.upper)
    )
    inside = ((low <= 0) & (high >= 0)).double().mean()
    return {
        "rmse": float(off.square().mean().sqrt()),
        "coverage": None if learner == "authors" else float(inside),
        "half_width": None if learner == "authors" else float((high - low).mean() / 2),
        "estimation": parameters if learner == "fitted" else None,
        "path": {
            name: [round(x, 3) for x in each[3::4].tolist()]
            for name, each in (("off", off), ("low", low), ("high", high))
        },
        "seconds": time.perf_counter() - begin,
    }


def tables(runs: Sequence[Run], experiment: Emps) -> dict[str, Table]:
    """All tables, by name."""
    parts = groups(frame(runs), "learner", experiment.axes["learner"])
    columns: dict[str, Cell] = {
        "runs": len,
        "RMSE, mm": lambda own: _mean(own["rmse"], ".2f"),
        "mean path of all runs, RMSE, mm": _pooled,
        "worst run, mm": of("rmse", "max", ".2f"),
        "95 % hold": lambda own: _mean(own["coverage"].astype(float), ".2f"),
        "half width of 95 %, mm": lambda own: _mean(own["half_width"].astype(float), ".1f"),
        "seconds": of("seconds", "mean", ".0f"),
    }
    text = table(parts, columns, "learner")
    published = [[f"{n}, {source}", "", number(error)] for n, (error, source) in PUBLISHED.items()]
    text = with_rows(text, published)
    rows = [[f"{n}, {u.unit}", f"{m:.2f} ± {s:.2f}"] for (n, u), (m, s) in
            zip(_UNKNOWNS.items(), AUTHORS.values(), strict=True)]  # fmt: skip
    for own in (run["estimation"] for run in runs if run["learner"] == "fitted"):
        for row, (mean, low, high) in zip(rows, own, strict=True):
            row.append(f"{mean:.2f} ({low:.2f} to {high:.2f})")
    header = ["", "the authors, ± sd", "smoothed, 95 %"][: len(rows[0])]
    return {
        "learners": Table("Simulation of the validation record", text),
        "parameters": Table("The four unknowns", markdown(header, rows)),
    }


def _mean(values: pd.Series[float], form: str) -> str:
    """The mean, with its standard error if there are several."""
    found = Difference.of(values)
    error = "" if np.isnan(found.error) else f" ± {found.error:{form}}"
    return number(found.mean, form) + error


def _pooled(own: pd.DataFrame) -> str:
    """The states are not known: the error of the mean of free runs of all that they may be."""
    off = np.mean([path["off"] for path in own["path"]], axis=0)
    return number(float(np.sqrt(np.mean(off**2))), ".2f") if len(own) > 1 else ""


def draw(runs: Sequence[Run], experiment: Emps) -> list[Path]:
    """Draw the errors of the first free run of each learner."""
    labels = experiment.axes["learner"]
    paths = {run["learner"]: run["path"] for run in reversed(runs)}
    shown = [name for name in ("fitted", "delta", "cka") if name in paths]
    figure, axes = panels([labels[name] for name in shown], 3, (3.6, 3.0))
    for ax, name in zip(axes, shown, strict=False):
        path = paths[name]
        seconds = _SAMPLING * experiment.every * (4 + 4 * np.arange(len(path["off"])))
        ax.fill_between(seconds, path["low"], path["high"], color="tab:blue", alpha=0.25, lw=0)
        ax.plot(seconds, path["off"], color="tab:blue")
        ax.axhline(0.0, color="black", lw=0.8)
        ax.set(xlabel="s", ylim=(-60, 60))
    axes[0].set_ylabel("simulated less measured position, mm")
    return [save(figure, experiment.folder / "emps.png")]
