"""Learn two tanks from the estimation record, and follow the validation record."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from functools import cache
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from gpadjust.core import SamplingWarning
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics
from gpadjust.records import SmoothedRecords, SmoothingWarning, smooth
from paper.common.experiment import Run, Table
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, frame, groups, of, table, with_rows
from paper.common.verdicts import Difference
from paper.machines import CHOSEN, Tanks
from paper.machines.tanks_systems import FULL, SPEC, START, levels, measured, outputs, physics

PUBLISHED = {
    "linear": 0.588,
    "polynomial NARX": 0.413,
    "GRU": 0.396,
    "CT-SUBNET": 0.306,
    "grey box (Worden 2018)": 0.191,
}
"""Errors in V of free runs along the validation record."""


def _smooth(*arguments: Any, **options: Any) -> SmoothedRecords:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        return smooth(*arguments, start=START, **options)


@cache
def fitted(sensor: str, experiment: Tanks) -> SmoothedRecords:
    """Parameters of f_p, and where the upper tank began, by the estimation record."""
    noise = torch.tensor([torch.nan, experiment.noise], dtype=torch.float64)
    scatter = torch.tensor(CHOSEN[sensor], dtype=torch.float64)
    options: dict[str, Any] = {"num_starts": experiment.starts, "max_rounds": experiment.rounds}
    records = levels(*measured("Est", experiment.samples))
    return _smooth(records, physics(sensor), noise=noise, process_noise=scatter, **options)


def run(experiment: Tanks, sensor: str, learner: str, seed: int) -> Run:
    """Learn from the estimation record; return error in V and coverage of a free run."""
    warnings.simplefilter("ignore", SamplingWarning)
    begin = time.perf_counter()
    actions, lower = measured("Val", experiment.samples)
    given: dict[str, Any] = {"num_functions": experiment.num_functions}
    if learner == "gp":
        records = outputs(*measured("Est", experiment.samples))
        dynamics: Any = LearnedDynamics(records.spec, model=LEARNERS["gp"].make)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Left out", UserWarning)
            data = records.trajectories()
        start = torch.stack([lower[0], lower[0], actions[0]])[None]  # nothing changed before
        given["start_noise"] = "learnt"
    else:
        known = fitted(sensor, experiment)
        found = known.physics_parameters
        f_p = physics(sensor, dict(zip(found, found.mean.tolist(), strict=True)))
        start = torch.stack([known.records.records[0].states[0, 0], lower[0]])[None]
        noise = known.noise.nan_to_num()
        process: Any = known.process_noise
        if learner == "fitted":
            dynamics = PhysicsDynamics(SPEC, f_p)
        else:
            # With little process noise states follow f_p, and there is nothing to learn about it.
            states = _smooth(levels(*measured("Est", experiment.samples)), f_p)
            noise = states.noise.nan_to_num()
            process = "learnt"
            data = states.draw(seed).trajectories()
            model = LEARNERS["phymean" if learner == "delta" else "cka"].make
            dynamics = LearnedDynamics(SPEC, f_p, model=model)
        start_sd = torch.stack([known.sd[0][0, 0], noise[1]])
        given |= {"noise": noise, "process_noise": process, "start_noise": start_sd}
    if learner != "fitted":
        dynamics.update(*data.spread(min(experiment.transitions, len(data.states)), seed))
    free = dynamics.free_run(start, actions[None, :-1, None], **given)
    column = free.spec.states.index("lower")

    def level(path: Tensor) -> Tensor:
        return torch.cat([lower[:1], path[0, :, column]]).clamp(0.0, FULL)

    low, high, mean = level(free.lower), level(free.upper), level(free.mean)
    if learner == "fitted":
        mean = _path(f_p, start, actions)
    inside = (lower >= low - 1e-9) & (lower <= high + 1e-9)
    return {
        "rmse": float((mean - lower)[1:].square().mean().sqrt()),
        "coverage": float(inside[1:].double().mean()),
        "width": float((high - low)[1:].mean()),
        "seconds": time.perf_counter() - begin,
    }


def _path(f_p: Any, start: Tensor, actions: Tensor) -> Tensor:
    """The level of the lower tank by f_p alone, without noise."""
    function, path = PhysicsDynamics(SPEC, f_p).mean_function(), [start]
    for action in actions[:-1]:
        path.append(function(path[-1][None], action.view(1, 1, 1))[0])
    return torch.cat(path)[:, 1].clamp(0.0, FULL)


def tables(runs: Sequence[Run], experiment: Tanks) -> dict[str, Table]:
    """A row for each learner, beside published errors."""
    axes = experiment.axes

    def rmse(part: pd.DataFrame) -> str:
        found = Difference.of(part["rmse"])
        return f"{found.mean:.3f}" + (f" ± {found.error:.3f}" if found.n > 1 else "")

    columns: dict[str, Cell] = {
        "RMSE, V": rmse,
        "worst run, V": of("rmse", "max", ".3f"),
        "runs": len,
        "95 % hold": of("coverage", "mean", ".2f"),
        "width of 95 %, V": of("width", "mean", ".2f"),
        "seconds": of("seconds", "median", ".0f"),
    }
    rows = groups(
        frame(runs),
        ["sensor", "learner"],
        lambda s, n: f"{axes['learner'][n]}, {axes['sensor'][s]}",
    )
    text = table(rows, columns, "learner")
    published = sorted(PUBLISHED.items(), key=lambda pair: pair[1])
    text = with_rows(text, [[f"{name}, published", f"{error:.3f}"] for name, error in published])
    return {"learners": Table("Free runs of the validation record", text)}
