"""Learn from the first part of a record, choose there, and follow its rest without looking.

Parts are those of PR-SSM's code (boschresearch/PR-SSM at 87d2488: 500, 148 and 250 rows teach), of
the tanks those of RGP's (1,250 rows), and errors are in the unit of the file, as there. A free run
begins at the last row that was learnt from and reads no output of the test part; those of PR-SSM
read its first 16.

f_p, its process noise and what GPs read were chosen by folds of the first parts, and no test part,
in an earlier experiment (``earlier.md``), which has the candidates.
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

from gpadjust.dynamics import FreeRun, LearnedDynamics, PhysicsDynamics
from gpadjust.records import SmoothedRecords, smooth
from paper.common.experiment import Run, Table
from paper.common.figures import one_legend, panels, save
from paper.common.free_runs import ends_of, path_of
from paper.common.learners import LEARNERS
from paper.common.tables import across, frame, groups, mean_error, number, of, table
from paper.common.verdicts import scores_of
from paper.published import Freeruns, published
from paper.published.freeruns_systems import SYSTEMS, narx_spec, records

_ROWS = 125  # of a path that is kept


@cache
def smoothed(record: str, experiment: Freeruns) -> SmoothedRecords:
    """Smooth the first part of a record, with f_p's parameters."""
    system, given = SYSTEMS[record], dict[str, Any]()
    if system.noise is not None:
        whole = (*system.noise, *[1.0] * system.delay)  # earlier actions have none
        given["process_noise"] = torch.tensor(whole, dtype=torch.float64)
    output, rows = system.column(system.output), slice(0, system.train)
    return smooth(
        records(output[rows, None], system.column(system.action)[rows], system.spec()),
        system.physics(),
        start=system.start,
        num_starts=experiment.starts,
        max_rounds=experiment.rounds,
        **given,
    )


def run(experiment: Freeruns, record: str, learner: str, seed: int) -> Run:
    """Learn from the first part of a record, and follow the rest."""
    begin, system = time.perf_counter(), SYSTEMS[record]
    free = _followed(experiment, record, learner, seed)
    output = system.column(system.output)[system.train :]
    mean, low, high = ends_of(free)
    if learner == "fitted":
        known = smoothed(record, experiment)
        f_p = system.physics(known.physics_parameters.mean.tolist())
        actions = system.column(system.action)[system.train - 1 : -1]
        mean = path_of(system.spec(), f_p, _last(record, known, 0), actions)[:, 0]
    results: Run = scores_of(mean, low, high, output)
    if learner == "cka" and seed == experiment.seed:
        path, every = {"mean": mean, "low": low, "high": high}, -(-len(output) // _ROWS)
        results["path"] = {
            name: part[::every].round(decimals=5).tolist() for name, part in path.items()
        }
    return {**results, "seconds": time.perf_counter() - begin}


def _followed(experiment: Freeruns, record: str, learner: str, seed: int) -> FreeRun:
    """Return a free run; a GP without f_p reads outputs and actions, others the states of f_p."""
    system, rows = SYSTEMS[record], SYSTEMS[record].train
    actions, output = system.column(system.action), system.column(system.output)
    given: dict[str, Any] = {"num_functions": experiment.num_functions}
    if learner == "gp":
        outputs, lags = system.narx
        spec, states = narx_spec(outputs, lags), output[:rows, None]
        dynamics: Any = LearnedDynamics(spec, model=LEARNERS["gp"].make)
        columns = [output[rows - 1 - k] for k in range(outputs)]
        columns += [actions[rows - 1 - k] for k in range(1, lags)]
        start, given["start_noise"] = torch.stack(columns)[None], "learnt"
    else:
        known, moving = smoothed(record, experiment), len(system.states)
        earlier = 0 if learner == "fitted" else system.earlier
        spec = system.spec(earlier)
        f_p = system.physics(known.physics_parameters.mean.tolist())
        start = _last(record, known, earlier)
        noise, start_noise = torch.zeros(2, spec.state_dim, dtype=torch.float64)
        noise[:moving] = known.noise[:moving].nan_to_num()
        start_noise[:moving] = known.sd[0][-1, :moving]
        given |= {"noise": noise, "start_noise": start_noise}
        if learner == "fitted":
            dynamics, given["process_noise"] = PhysicsDynamics(spec, f_p), known.process_noise
        else:
            states = known.draw(seed).records[0].states[:, :moving]
            dynamics = LearnedDynamics(spec, f_p, model=LEARNERS[learner].make)
            given["process_noise"] = "learnt"
    if learner != "fitted":
        # Smoothing leaves out rows whose action is not known.
        data = records(states, actions[rows - len(states) : rows], spec).trajectories()
        number = min(experiment.transitions, len(data.states))
        dynamics.update(*data.spread(number, seed))
    return dynamics.free_run(start, actions[None, rows - 1 : -1, None], **given)


def _last(record: str, known: SmoothedRecords, earlier: int) -> Tensor:
    """Return the last smoothed state with earlier actions, ``1 x state_dim``."""
    system = SYSTEMS[record]
    actions = system.column(system.action)
    state = known.records.records[0].states[-1, : len(system.states)]
    lags = [actions[system.train - 1 - k] for k in range(1, max(earlier, system.delay) + 1)]
    return torch.cat([state, torch.stack(lags)] if lags else [state])[None]


def tables(runs: Sequence[Run], experiment: Freeruns) -> dict[str, Table]:
    """Return errors and coverage of each learner."""
    found, labels = frame(runs), experiment.axes["record"]
    names = experiment.axes["learner"]

    def rmse(part: pd.DataFrame) -> str:
        differ = part["rmse"].std() > 1e-9
        return (mean_error("rmse", ".3f", ".1g") if differ else of("rmse", "mean", ".3f"))(part)

    there = [name for name in labels if (found["record"] == name).any()]
    more = [["mean of the first part", *map(_trivial, there)]]
    for method, errors in published("freeruns").items():
        known = dict(zip(labels, errors, strict=False))
        more.append([f"{method}, published", *(known.get(name, "") for name in there)])
    columns = across(found, "record", labels, rmse)
    text = table(groups(found, "learner", names), columns, "RMSE", more)
    shown = {"95 % coverage": of("coverage", "mean", ".2f"), "half width of 95 %": of("half_width")}
    shown |= {"seconds": of("seconds", "mean", ".0f"), "runs": len}
    each = groups(found, ["record", "learner"], lambda r, name: f"{labels[r]}, {names[name]}")
    return {
        "errors": Table("RMSE of free runs along the test part", text),
        "details": Table("Intervals and seconds", table(each, shown, "record, learner")),
    }


def _trivial(name: str) -> str:
    """Return the error of the mean of the first part."""
    output, train = SYSTEMS[name].column(SYSTEMS[name].output), SYSTEMS[name].train
    return number(float((output[train:] - output[:train].mean()).square().mean().sqrt()), ".3f")


def draw(runs: Sequence[Run], experiment: Freeruns) -> list[Path]:
    """Draw the first free run of CKA of each record."""
    first = [r for r in runs if r["learner"] == "cka" and r["seed"] == experiment.seed]
    shown = {run["record"]: run["path"] for run in first}
    titles = {name: label for name, label in experiment.axes["record"].items() if name in shown}
    if not titles:
        return []
    titled = [f"{label}: CKA" for label in titles.values()]
    figure, axes = panels(titled, 2, (4.4, 2.2), share=False)
    for ax, name in zip(axes, titles, strict=True):
        system, path = SYSTEMS[name], shown[name]
        measured = system.column(system.output)[system.train :]
        rows = -(-len(measured) // len(path["mean"])) * np.arange(len(path["mean"]))
        ax.fill_between(rows, path["low"], path["high"], color="tab:blue", alpha=0.25, lw=0,
                        label="95 %")  # fmt: skip
        ax.plot(rows, path["mean"], color="tab:blue", label="free run")
        ax.plot(measured.tolist(), color="black", lw=0.9, ls="--", label="measured")
        low, high = float(measured.min()), float(measured.max())
        ax.set_ylim(low - 0.6 * (high - low), high + 0.6 * (high - low))
        ax.set(xlabel="row of the test part")
    one_legend(figure, axes)
    return [save(figure, experiment.folder / "freeruns.png")]
