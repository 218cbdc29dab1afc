"""Learn from the first part of a record, choose there, and follow its rest without looking.

Parts are those of PR-SSM's code (boschresearch/PR-SSM at 87d2488: 500, 148 and 250 rows teach), of
the tanks those of RGP's (1,250 rows), and errors are in the unit of the file, as there. A free run
begins at the last row that was learnt from and reads no output of the test part; those of PR-SSM
read its first 16.

f_p, its process noise and what GPs read were chosen by folds of the first parts, and no test part,
in an earlier experiment (``earlier.md``), which has the candidates.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.core import SamplingWarning
from gpadjust.dynamics import FreeRun, LearnedDynamics, PhysicsDynamics
from gpadjust.records import SmoothedRecords, SmoothingWarning, smooth
from paper.common.experiment import Run, Table
from paper.common.figures import one_legend, panels, save
from paper.common.tables import across, frame, groups, number, of, table, with_rows
from paper.common.verdicts import Difference
from paper.published import Freeruns
from paper.published.freeruns_systems import SYSTEMS, narx_spec, records

PUBLISHED = {
    "DKF": (0.144, 5.589, 0.735),
    "vGPSSM": (0.268, 3.676, 0.740),
    "CO-GPSSM": (0.079, 1.898, 0.736),
    "ODGPSSM": (0.068, 1.704, 0.708),
    "VCDT": (0.065, 2.052, 0.735),
    "AD-EnKF": (0.057, 1.408, 0.756),
    "PR-SSM": (0.074, 1.503, 0.647),
    "EnVI": (0.055, 1.388, 0.703),
}
"""Errors of ball and beam, furnace and drive in table II of Lin et al. 2024 (arXiv 2312.05910)."""
_MODELS = {"delta": PhysicsMeanGP, "cka": CKA, "gp": ZeroMeanGP}
_ROWS = 125  # of a path that is kept


@cache
def smoothed(record: str, experiment: Freeruns) -> SmoothedRecords:
    """States and parameters by the first part of a record."""
    system, given = SYSTEMS[record], dict[str, Any]()
    if system.noise is not None:
        whole = (*system.noise, *[1.0] * system.delay)  # earlier actions have none
        given["process_noise"] = torch.tensor(whole, dtype=torch.float64)
    output, rows = system.column(system.output), slice(0, system.train)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
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
    warnings.simplefilter("ignore", SamplingWarning)
    begin, system = time.perf_counter(), SYSTEMS[record]
    free = _followed(experiment, record, learner, seed)
    output = system.column(system.output)[system.train :]
    mean, low, high = (each[0, :, 0] for each in (free.mean, free.lower, free.upper))
    if learner == "fitted":
        mean = _path(experiment, record)
    every = -(-len(output) // _ROWS)
    kept = {"mean": mean, "low": low, "high": high}
    return {
        "rmse": float((mean - output).square().mean().sqrt()),
        "coverage": float(((low <= output) & (output <= high)).double().mean()),
        "half_width": float((high - low).mean() / 2),
        "path": {
            name: [round(x, 5) for x in part[::every].tolist()] for name, part in kept.items()
        },
        "seconds": time.perf_counter() - begin,
    }


def _path(experiment: Freeruns, record: str) -> Tensor:
    """The output by f_p alone, without noise."""
    system, known = SYSTEMS[record], smoothed(record, experiment)
    f_p = system.physics(known.physics_parameters.mean.tolist())
    step = PhysicsDynamics(system.spec(), f_p).mean_function()
    state, outputs = _last(record, known, 0), []
    for action in system.column(system.action)[system.train - 1 : -1]:
        state = step(state[None], action.view(1, 1, 1))[0]
        outputs.append(state[0, 0])
    return torch.stack(outputs)


def _followed(experiment: Freeruns, record: str, learner: str, seed: int) -> FreeRun:
    """A free run; a GP without f_p reads outputs and actions, beside f_p its states."""
    system, rows = SYSTEMS[record], SYSTEMS[record].train
    actions, output = system.column(system.action), system.column(system.output)
    given: dict[str, Any] = {"num_functions": experiment.num_functions}
    if learner == "gp":
        outputs, lags = system.narx
        spec, states = narx_spec(outputs, lags), output[:rows, None]
        dynamics: Any = LearnedDynamics(spec, model=ZeroMeanGP)
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
            dynamics = LearnedDynamics(spec, f_p, model=_MODELS[learner])
            given["process_noise"] = "learnt"
    if learner != "fitted":
        # Smoothing leaves out rows whose action is not known.
        data = records(states, actions[rows - len(states) : rows], spec).trajectories()
        number = min(experiment.transitions, len(data.states))
        dynamics.update(*data.spread(number, seed))
    return dynamics.free_run(start, actions[None, rows - 1 : -1, None], **given)


def _last(record: str, known: SmoothedRecords, earlier: int) -> Tensor:
    """The last smoothed state with earlier actions, ``1 x state_dim``."""
    system = SYSTEMS[record]
    actions = system.column(system.action)
    state = known.records.records[0].states[-1, : len(system.states)]
    lags = [actions[system.train - 1 - k] for k in range(1, max(earlier, system.delay) + 1)]
    return torch.cat([state, torch.stack(lags)] if lags else [state])[None]


def tables(runs: Sequence[Run], experiment: Freeruns) -> dict[str, Table]:
    """Errors, and what intervals hold, of each learner."""
    found, labels = frame(runs), experiment.axes["record"]
    names = experiment.axes["learner"]
    parts = groups(found, "learner", names)

    def rmse(part: pd.DataFrame) -> str:
        of_all = Difference.of(part["rmse"].astype(float))
        several = math.isfinite(of_all.error) and of_all.error > 1e-9
        return number(of_all.mean, ".3f") + (f" ± {of_all.error:.1g}" if several else "")

    text = table(parts, across(found, "record", labels, rmse), "RMSE")
    there = [name for name in labels if (found["record"] == name).any()]
    more = {"mean of the first part": [_trivial(name) for name in there]}
    for method, errors in PUBLISHED.items():
        known = dict(zip(labels, errors, strict=False))
        more[f"{method}, published"] = [number(known.get(name, math.nan), ".3f") for name in there]
    text = with_rows(text, [[label, *cells] for label, cells in more.items()])
    shown = {"95 % hold": of("coverage", "mean", ".2f"), "half width of 95 %": of("half_width")}
    shown |= {"seconds": of("seconds", "mean", ".0f"), "runs": len}
    each = groups(found, ["record", "learner"], lambda r, name: f"{labels[r]}, {names[name]}")
    return {
        "errors": Table("RMSE of free runs along the test part", text),
        "details": Table("Intervals and seconds", table(each, shown, "record, learner")),
    }


def _trivial(name: str) -> str:
    """The error of the mean of the first part."""
    output, train = SYSTEMS[name].column(SYSTEMS[name].output), SYSTEMS[name].train
    return number(float((output[train:] - output[:train].mean()).square().mean().sqrt()), ".3f")


def draw(runs: Sequence[Run], experiment: Freeruns) -> list[Path]:
    """Draw the first free run of CKA of each record."""
    shown = {run["record"]: run["path"] for run in reversed(runs) if run["learner"] == "cka"}
    titles = {name: label for name, label in experiment.axes["record"].items() if name in shown}
    if not titles:
        return []
    figure, axes = panels(
        [f"{label}: CKA" for label in titles.values()], 2, (4.4, 2.2), share=False
    )
    for ax, name in zip(axes, titles, strict=False):
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
