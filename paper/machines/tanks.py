"""Learn two tanks from the estimation record, and follow the validation record."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch

from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics
from gpadjust.records import SmoothedRecords, smooth
from paper.common.experiment import Run, Table
from paper.common.free_runs import ends_of, path_of
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, frame, groups, mean_error, of, table
from paper.common.verdicts import scores_of
from paper.machines import CHOSEN, Tanks
from paper.machines.tanks_systems import FULL, SPEC, START, levels, measured, outputs, physics
from paper.published import published


@cache
def fitted(sensor: str, experiment: Tanks) -> SmoothedRecords:
    """Fit parameters of f_p, and where the upper tank began, to the estimation record."""
    noise = torch.tensor([torch.nan, experiment.noise], dtype=torch.float64)
    scatter = torch.tensor(CHOSEN[sensor], dtype=torch.float64)
    return smooth(
        levels(*measured("Est", experiment.samples)),
        physics(sensor),
        start=START,
        noise=noise,
        process_noise=scatter,
        num_starts=experiment.starts,
        max_rounds=experiment.rounds,
    )


def run(experiment: Tanks, sensor: str, learner: str, seed: int) -> Run:
    """Learn from the estimation record; return error in V and coverage of a free run."""
    begin = time.perf_counter()
    actions, lower = measured("Val", experiment.samples)
    given: dict[str, Any] = {"num_functions": experiment.num_functions}
    if learner == "gp":
        records = outputs(*measured("Est", experiment.samples))
        dynamics: Any = LearnedDynamics(records.spec, model=LEARNERS["gp"].make)
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
            states = smooth(levels(*measured("Est", experiment.samples)), f_p, start=START)
            noise = states.noise.nan_to_num()
            process = "learnt"
            data = states.draw(seed).trajectories()
            dynamics = LearnedDynamics(SPEC, f_p, model=LEARNERS[learner].make)
        start_sd = torch.stack([known.sd[0][0, 0], noise[1]])
        given |= {"noise": noise, "process_noise": process, "start_noise": start_sd}
    if learner != "fitted":
        dynamics.update(*data.spread(min(experiment.transitions, len(data.states)), seed))
    free = dynamics.free_run(start, actions[None, :-1, None], **given)
    ends = ends_of(free, free.spec.states.index("lower"))
    mean, low, high = (each.clamp(0.0, FULL) for each in ends)
    if learner == "fitted":
        mean = path_of(SPEC, f_p, start, actions[:-1])[:, 1].clamp(0.0, FULL)
    scores = scores_of(mean, low, high, lower[1:])
    near = scores_of(mean, low - 1e-9, high + 1e-9, lower[1:])
    results = {"rmse": scores["rmse"], "coverage": near["coverage"]}
    results["width"] = 2 * scores["half_width"]
    return {**results, "seconds": time.perf_counter() - begin}


def tables(runs: Sequence[Run], experiment: Tanks) -> dict[str, Table]:
    """Return a table with a row for each learner, and published errors."""
    axes = experiment.axes
    columns: dict[str, Cell] = {
        "RMSE, V": mean_error("rmse", ".3f"),
        "worst run, V": of("rmse", "max", ".3f"),
        "runs": len,
        "95 % coverage": of("coverage", "mean", ".2f"),
        "width of 95 %, V": of("width", "mean", ".2f"),
        "seconds": of("seconds", "median", ".0f"),
    }
    rows = groups(
        frame(runs),
        ["sensor", "learner"],
        lambda s, n: f"{axes['learner'][n]}, {axes['sensor'][s]}",
    )
    more = [[f"{name}, published", *error] for name, error in published("tanks").items()]
    text = table(rows, columns, "learner", more)
    return {"learners": Table("Free runs of the validation record", text)}
