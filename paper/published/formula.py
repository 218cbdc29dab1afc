"""The error of the default in that of the formula that it was given, over all chapters.

A cell is a problem with a number of data; its error is that of new observations, over several data
sets. f_p is the formula as it is given; if it has unknown parameters, as it is fitted to the same
data, by its priors. The prior probabilities of the default fit (the physics alone 0.6) were chosen
on these problems, of the seeds 1000 to 1007; runs of the seeds 0 to 3 and 100 to 109 came before a
quarter of the samples were left to the adjusted model.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust import CKA, CalibratedPhysics, fit
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics
from gpadjust.physics import Physics, as_physics
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.runs import RunsFile
from paper.common.tables import Cell, table
from paper.common.verdicts import Difference
from paper.parameters.laws import PROBLEMS as LAWS
from paper.parameters.laws import case, textbook_case
from paper.published import GROUPS, TABLES, Formula, Uci
from paper.structures import PUMP, label
from paper.structures.data import of_pair, pump
from paper.structures.problems import PROBLEMS
from paper.structures.systems import System, system

_POINTS = 500
MOST = 1.02  # of the formula's error


class Data(NamedTuple):
    """Observations to learn from, a formula, and new observations."""

    X: Tensor
    Y: Tensor
    physics: Physics | Callable[[Tensor], Tensor]
    points: Tensor
    expected: Tensor


def _function(name: str, per_input: int, noise: float, seed: int) -> Data:
    """A pair of functions of high and low fidelity, or the pump."""
    is_pump = name == PUMP[0]
    data = pump(12, seed) if is_pump else of_pair(name, per_input, noise, _POINTS, seed)
    generator = torch.Generator().manual_seed(seed + 1_000_000)
    new = data.noise * torch.randn(data.truth.shape, generator=generator, dtype=torch.float64)
    return Data(data.X, data.Y, data.physics, data.points, data.truth + new)


def _kind(name: str, per_input: int, right: bool, seed: int) -> Data:
    """A function of the unit cube and its physics, or that physics as the truth, with noise."""
    problem, d = PROBLEMS[name], PROBLEMS[name].num_inputs
    truth = problem.physics if right else problem.truth
    generator = torch.Generator().manual_seed(seed)
    X = SobolEngine(d, scramble=True, seed=seed).draw(per_input * d, dtype=torch.float64)
    points = SobolEngine(d, scramble=True, seed=1).draw(_POINTS, dtype=torch.float64)
    noise = (0.1 if right else problem.noise) * truth(points).std()

    def observed(X: Tensor) -> Tensor:
        values = truth(X)
        white = torch.randn(values.shape, generator=generator, dtype=torch.float64)
        return (values + noise * white).unsqueeze(-1)

    return Data(X, observed(X), problem.physics, points, observed(points))


def _law(name: str, seed: int) -> Data:
    """A law with unknown parameters.

    New observations of a system that follows its law are anywhere in the box of the others; of one
    that does not, each fourth of all is left out.
    """
    if name not in LAWS:
        drawn = textbook_case(name, seed)
        out = torch.arange(len(drawn.X)) % 4 == 2
        return Data(drawn.X[~out], drawn.Y[~out], drawn.physics, drawn.X[out], drawn.Y[out])
    drawn = case(name, seed)
    low, high = torch.tensor(LAWS[name].box, dtype=torch.float64)
    share = SobolEngine(len(low), scramble=True, seed=1).draw(_POINTS, dtype=torch.float64)
    points = low + share * (high - low)
    generator = torch.Generator().manual_seed(seed + 1_000_000)
    white = torch.randn(_POINTS, 1, generator=generator, dtype=torch.float64)
    true = torch.tensor([*drawn.true.values()], dtype=torch.float64)
    new = drawn.physics(points, true) + drawn.noise * white
    return Data(drawn.X, drawn.Y, drawn.physics, points, new)


def run(experiment: Formula, group: str, problem: str, size: int, noise: float, seed: int) -> Run:
    """Fit the default to one data set; return its errors and the formula's, of each output."""
    warnings.simplefilter("ignore")
    begin = time.perf_counter()
    if group in ("simulated", "measured"):
        ours, formula, held = _of_system(system(problem, size, experiment.num_transitions, seed))
    elif group == "functions":
        ours, formula, held = _of_data(_function(problem, size, noise, seed))
    elif group in ("kinds", "right"):
        ours, formula, held = _of_data(_kind(problem, size, group == "right", seed))
    else:
        ours, formula, held = _of_data(_law(problem, seed))
    return {
        "ours": ours.tolist(),
        "formula": formula.tolist(),
        "held": held.tolist(),
        "seconds": time.perf_counter() - begin,
    }


def _of_data(data: Data) -> tuple[Tensor, Tensor, Tensor]:
    """Root mean squares of the errors, and coverage, ``m`` each."""
    physics = as_physics(data.physics)
    model = CKA(data.X, data.Y, physics=physics)
    fit(model)
    with torch.no_grad():
        mean = model.predict(data.points).mean
        low, high = model.interval(data.points, observation_noise=True)
        held = ((low <= data.expected) & (data.expected <= high)).double().mean(0)
        if physics.unknowns:
            fitted = CalibratedPhysics(data.X, data.Y, physics=physics)
            fit(fitted)
            alone = fitted.predict(data.points).mean
        else:
            alone = physics(data.points).reshape(data.expected.shape)
    return _rmse(mean, data.expected), _rmse(alone, data.expected), held


def _rmse(mean: Tensor, expected: Tensor) -> Tensor:
    return (mean - expected).square().mean(0).sqrt()


def _of_system(data: System) -> tuple[Tensor, Tensor, Tensor]:
    """Root mean squares of the errors of one step's change, and coverage, ``m`` each."""
    dynamics = LearnedDynamics(data.spec, data.physics, model=CKA)
    dynamics.update(*data.train)
    ours = dynamics.score(*data.test)
    return ours.rmse, PhysicsDynamics(data.spec, data.physics).score(*data.test).rmse, ours.coverage


def cells(runs: Sequence[Run], experiment: Formula) -> pd.DataFrame:
    """A row for each cell: its group, its label, and the logarithm of errors, ours / the formula's.

    Cells of `uci` count whose runs lie beside these.
    """
    found = [
        {
            "group": run["group"],
            "cell": _label(run),
            "gap": float(np.mean(np.log(np.divide(run["ours"], run["formula"])))),
            "held": float(np.mean(run["held"])),
        }
        for run in runs
    ]
    file = RunsFile(experiment.out.parent / Uci.name / "runs.jsonl", Uci.key)
    beside = {
        (run["table"], run["share"], run["seed"], run["method"]): run
        for run in file.read().values()
    }
    for (name, share, seed, method), run in beside.items():
        alone = beside.get((name, share, seed, "formula"))
        if method == "cka" and alone is not None:
            text = f"{TABLES[name]}, {100 * share:.0f} % of the rows"
            gap = math.log(run["rmse"] / alone["rmse"])
            found.append({"group": "uci", "cell": text, "gap": gap, "held": run["coverage"]})
    return pd.DataFrame(found).dropna()


def _label(run: Run) -> str:
    name, size = run["problem"], run["size"]
    if run["group"] == "laws":
        return str(name)
    if run["group"] == "functions":
        return label(name, size, run["noise"]) if name != PUMP[0] else "pump"
    each = "" if run["group"] in ("simulated", "measured") else " for each input"
    return f"{name}, {size}{each}"


def tables(runs: Sequence[Run], experiment: Formula) -> dict[str, Table]:
    """All tables, by name."""
    found = cells(runs, experiment)
    names = {**GROUPS, "uci": "yacht, energy, concrete"}
    groups = {text: found[found["group"] == name] for name, text in names.items()}
    groups = {text: part for text, part in groups.items() if len(part)} | {"all": found}
    columns: dict[str, Cell] = {
        "cells": lambda part: len(_ratios(part)),
        "error, ours / the formula's": lambda part: Difference.of(
            [each.mean for each in _ratios(part).values()]
        ).ratio(),
        f"cells at most {MOST}": lambda part: f"{(_means(part) <= MOST).mean():.0%}",
        f"surely above {MOST}": lambda part: sum(
            each.low > math.log(MOST) for each in _ratios(part).values()
        ),
        "worst cell": _worst,
        "worst data set": lambda part: f"{math.exp(part['gap'].max()):.2f}",
        "95 % hold": lambda part: f"{part.groupby('cell')['held'].mean().mean():.3f}",
    }
    each = {
        f"{names[group]}: {cell}": part
        for (group, cell), part in found.groupby(["group", "cell"], sort=False)
    }
    single: dict[str, Cell] = {
        "error, ours / the formula's": lambda part: Difference.of(part["gap"]).ratio(),
        "worst data set": lambda part: f"{math.exp(part['gap'].max()):.2f}",
        "95 % hold": lambda part: f"{part['held'].mean():.2f}",
        "data sets": len,
    }
    return {
        "groups": Table("Errors on left-out data, ours / the formula's", table(groups, columns)),
        "cells": Table("Each cell", table(each, single, "cell")),
    }


def _ratios(part: pd.DataFrame) -> dict[str, Difference]:
    keys = part["group"] + part["cell"]
    return {name: Difference.of(own["gap"]) for name, own in part.groupby(keys, sort=False)}


def _means(part: pd.DataFrame) -> np.ndarray:
    return np.exp([each.mean for each in _ratios(part).values()])


def _worst(part: pd.DataFrame) -> str:
    means = part.groupby(["group", "cell"], sort=False)["gap"].mean()
    return f"{math.exp(means.max()):.2f}, {means.idxmax()[1]}"


def draw(runs: Sequence[Run], experiment: Formula) -> list[Path]:
    """Draw the ratio of each cell with its interval, sorted, and the same near one."""
    ratios = _ratios(cells(runs, experiment))
    order = sorted(ratios.values(), key=lambda each: each.mean)
    figure, (ax, near) = panels(["all cells", "the highest third"], 2, (4.6, 3.4), share=False)
    for axis, part in ((ax, order), (near, order[-(len(order) // 3 or 1) :])):
        x = np.arange(len(part))
        middle = np.exp([each.mean for each in part])
        half = [np.nan_to_num(each.half_width) for each in part]
        low, high = (
            np.exp([e.mean + s * h for e, h in zip(part, half, strict=True)]) for s in (-1, 1)
        )
        axis.vlines(x, low, high, color="0.7", lw=1.5)
        axis.plot(x, middle, ".", color="navy", ms=4)
        axis.axhline(1, color="0.3", lw=0.8)
        axis.axhline(MOST, color="tab:red", lw=0.8, ls=":")
        axis.set(xlabel="cells, sorted", ylabel="error, ours / the formula's", xticks=[])
    ax.set_yscale("log")
    return [save(figure, experiment.out / "formula.png")]
