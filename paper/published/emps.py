"""Learn a servo from one record, and simulate another one, with force pulses, from its first row.

The machine is that of Janot, Gautier and Brunot (2019). Its files hold the position as
(x - 0.125 m) / 0.125 m and the control signal in V, of which the drive makes 35.15065 N each.
``force`` of the files adds the pulses to a signal that has them already, and is not used.

Steps, transitions and draws were chosen by halves of the estimation record, before the first run of
an earlier experiment (``earlier.md``).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import FunctionPhysics, Unknown
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import ParameterValues
from gpadjust.records import Record, Records, SmoothedRecords, smooth
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.free_runs import ends_of, law_of
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, frame, groups, markdown, mean_error, number, of, table
from paper.common.verdicts import scores_of
from paper.published import Emps, published

DATA = Path(__file__).parent / "data" / "emps"
_SAMPLING = 0.005  # s
_NEWTON = 35.15065  # of a volt
_STROKE = 0.125  # m
_SUBSTEPS = 5
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


def measured(name: str, experiment: Emps) -> tuple[Tensor, Tensor]:
    """Return positions in m and mean forces in N of steps; between rows the force is linear."""
    file = pd.read_csv(DATA / f"{name}.csv")[: experiment.rows]
    q, volts = (torch.from_numpy(file[c].to_numpy(copy=True)) for c in ("q", "force_in"))
    force = _NEWTON * torch.cat([(volts[1:] + volts[:-1]) / 2, volts[-1:]])
    steps = len(q) // experiment.every
    each = force[: steps * experiment.every].view(steps, experiment.every).mean(1)
    return (_STROKE * (1 + q))[: steps * experiment.every : experiment.every], each


def spec_of(experiment: Emps) -> StateSpec:
    """Return the spec of position and velocity, of which models predict the latter alone."""
    step = _SAMPLING * experiment.every
    return StateSpec(["q", "v"], ["force"], step=step, integrated={"q": "v"})


def physics(step: float, values: Sequence[float] | None = None) -> FunctionPhysics:
    r"""Return the physics of the next state, with unknown parameters or these.

    :math:`M q'' = F - F_v q' - F_c \operatorname{sign} q' - c` (Janot et al. 2019). Dry friction
    decelerates, or holds what it has stopped, in each of five substeps.
    """
    h = step / _SUBSTEPS

    def servo(X: Tensor, p: ParameterValues) -> Tensor:
        q, v, force = X.unbind(-1)
        for _ in range(_SUBSTEPS):
            free = v + h * (force - p.Fv * v - p.c) / p.M
            slower = free.sign() * (free.abs() - h * p.Fc / p.M).clamp_min(0.0)
            q, v = q + h * (v + slower) / 2, slower
        return torch.stack([q, v], dim=-1)

    return law_of(servo, _UNKNOWNS, values)


@cache
def smoothed(experiment: Emps) -> SmoothedRecords:
    """Smooth the estimation record, which has no velocities, with f_p's parameters."""
    q, force = measured("estimation", experiment)
    spec = spec_of(experiment)
    states = torch.stack([q, torch.full_like(q, torch.nan)], dim=-1)
    times = _SAMPLING * experiment.every * torch.arange(len(q), dtype=torch.float64)
    records = Records([Record(times, states, force.unsqueeze(-1), name="servo")], spec)
    return smooth(
        records,
        physics(_SAMPLING * experiment.every),
        start={"v": (0.0, 0.01)},  # m/s: both records begin at rest
        num_starts=1,
        max_rounds=experiment.rounds,
    )


def run(experiment: Emps, learner: str, seed: int) -> Run:
    """Learn from the estimation record; return the errors in mm of a free run along the other."""
    (q, force), begin = measured("validation", experiment), time.perf_counter()
    step, spec = _SAMPLING * experiment.every, spec_of(experiment)
    given: dict[str, Any] = {"num_functions": experiment.num_functions, "noise": False}
    if learner == "authors":
        f_p = physics(step, [mean for mean, _ in AUTHORS.values()])
        dynamics: Dynamics = PhysicsDynamics(spec, f_p)
    else:
        known = smoothed(experiment)
        found = known.physics_parameters
        f_p = physics(step, found.mean.tolist())
        given |= {"noise": known.noise.nan_to_num(), "process_noise": known.process_noise}
        dynamics = PhysicsDynamics(spec, f_p)
    if learner not in experiment.single:
        made = LEARNERS[learner]
        learnt = LearnedDynamics(spec, f_p if made.adjusts else None, model=made.make)
        learnt.update(*known.draw(seed).trajectories())
        dynamics, given["process_noise"] = learnt, "learnt"
    start = torch.tensor([[float(q[0]), 0.0]], dtype=torch.float64)
    free = dynamics.free_run(start, force[None, :-1, None], **given)
    off, low, high = (1e3 * (each - q[1:]) for each in ends_of(free))
    results: Run = scores_of(off, low, high, torch.zeros_like(off))
    path = {"off": off, "low": low, "high": high}
    if learner == "authors":
        results |= {"coverage": None, "half_width": None}
    elif learner == "fitted":
        ends = torch.stack([found.mean, *found.interval()]).T
        results["estimation"] = ends.tolist()
    if seed > experiment.seed:
        del path["low"], path["high"]
    results["path"] = {name: each[3::4].round(decimals=3).tolist() for name, each in path.items()}
    return {**results, "seconds": time.perf_counter() - begin}


def tables(runs: Sequence[Run], experiment: Emps) -> dict[str, Table]:
    """Return all tables, by name."""
    columns: dict[str, Cell] = {
        "runs": len,
        "RMSE, mm": mean_error("rmse", ".2f"),
        "mean path of all runs, RMSE, mm": _pooled,
        "worst run, mm": of("rmse", "max", ".2f"),
        "95 % coverage": mean_error("coverage", ".2f"),
        "half width of 95 %, mm": mean_error("half_width", ".1f"),
        "seconds": of("seconds", "mean", ".0f"),
    }
    more = [[name, "", number(float(error))] for name, (error,) in published("emps").items()]
    parts = groups(frame(runs), "learner", experiment.axes["learner"])
    text = table(parts, columns, "learner", more)
    rows = [
        [f"{name}, {unknown.unit}", "{:.2f} ± {:.2f}".format(*AUTHORS[name])]
        for name, unknown in _UNKNOWNS.items()
    ]
    for own in (run["estimation"] for run in runs if run["learner"] == "fitted"):
        for row, ends in zip(rows, own, strict=True):
            row.append("{:.2f} ({:.2f} to {:.2f})".format(*ends))
    header = ["", "the authors, ± sd", "smoothed, 95 %"][: len(rows[0])]
    return {
        "learners": Table("Simulation of the validation record", text),
        "parameters": Table("The four unknowns", markdown(header, rows)),
    }


def _pooled(own: pd.DataFrame) -> str:
    """Return the error of the mean of free runs of all draws of the states, which are unknown."""
    off = np.mean([path["off"] for path in own["path"]], axis=0)
    return number(float(np.sqrt(np.mean(off**2))), ".2f") if len(own) > 1 else ""


def draw(runs: Sequence[Run], experiment: Emps) -> list[Path]:
    """Draw the errors of the first free run of each learner."""
    paths = {run["learner"]: run["path"] for run in runs if run["seed"] == experiment.seed}
    labels = experiment.axes["learner"]
    shown = {name: labels[name] for name in ("fitted", "delta", "cka", "gp") if name in paths}
    figure, axes = panels([*shown.values()], 4, (2.9, 3.0))
    for ax, path in zip(axes, [paths[name] for name in shown], strict=True):
        seconds = _SAMPLING * experiment.every * (4 + 4 * np.arange(len(path["off"])))
        ax.fill_between(seconds, path["low"], path["high"], color="tab:blue", alpha=0.25, lw=0)
        ax.plot(seconds, path["off"], color="tab:blue")
        ax.axhline(0.0, color="black", lw=0.8)
        ax.set(xlabel="s", ylim=(-60, 60))
    axes[0].set_ylabel("simulated less measured position, mm")
    return [save(figure, experiment.folder / "emps.png")]
