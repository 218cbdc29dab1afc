"""Errors of functions by few observations: CKA, what it contains, and the formula that is fitted.

An error is that of the function without noise, in its standard deviation, at points that all share.
The formula has what may be fitted: a factor and an offset by least squares, or its unknown
parameters by their priors. A cell is a problem with a number of observations.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust.validation import score
from paper.common.experiment import Run, Table, fitted
from paper.common.figures import panels, save
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, frame, groups, of, ratio_of, table
from paper.common.verdicts import Difference, paired
from paper.functions import GROUPS, Functions
from paper.functions import PROBLEMS as NAMES
from paper.functions.problems import PROBLEMS
from paper.parameters.laws import case

MOST, TOO_MUCH = 1.05, 1.3  # of the formula's error
_LEAST_DRAWN = 0.1  # ratio; smaller ones are drawn as triangles
_CELL = ["problem", "n"]
_GROUP = {name: group for group, names in NAMES.items() for name in names}
LAWS = NAMES["law"]


class Data(NamedTuple):
    """Observations, a formula, and points where the truth is known, with new observations."""

    X: Tensor
    Y: Tensor
    physics: Any
    points: Tensor
    truth: Tensor
    new: Tensor


def data_of(name: str, n: int, num_test: int, seed: int) -> Data:
    """Draw the data set of a seed."""
    generator = torch.Generator().manual_seed(seed)

    def noisy(f: Tensor, sd: Any) -> Tensor:
        return f + sd * torch.randn(f.shape, generator=generator, dtype=torch.float64)

    if name in LAWS:
        drawn, test = case(name, seed, n), case(name, seed, num_test, places=1)
        physics, noise = drawn.physics, drawn.noise
        return Data(drawn.X, drawn.Y, physics, test.X, test.system, noisy(test.system, noise))
    problem = PROBLEMS[name]
    X, points = problem.points(n, seed), problem.points(num_test, 1)
    truth = problem.truth(points)
    sd = problem.noise * truth.std()
    Y = noisy(problem.truth(X), sd)
    return Data(X, Y, problem.physics, points, truth, noisy(truth, sd))


def run(experiment: Functions, problem: str, n: int, learner: str, seed: int) -> Run:
    """Fit a learner to a data set; return its error, its density and its coverage."""
    data = data_of(problem, n, experiment.num_test, seed)
    sd, begin = data.truth.std(), time.perf_counter()
    if learner == "formula" and problem not in LAWS:
        error = _least_squares(data) - data.truth
        seconds = time.perf_counter() - begin
        return {"error": (error.square().mean().sqrt() / sd).item(), "seconds": seconds}
    model = LEARNERS[learner].make(data.X, data.Y, physics=data.physics)
    seconds = fitted(model)
    with torch.no_grad():
        mean = model.predict(data.points).mean
        scores = score(model.posterior(data.points, observation_noise=True), data.new)
    return {
        "error": ((mean - data.truth).square().mean().sqrt() / sd).item(),
        "nlpd": (scores.nlpd - sd.log()).item(),
        "coverage": scores.coverage.item(),
        "seconds": seconds,
    }


def _least_squares(data: Data) -> Tensor:
    """Return the formula with a factor and an offset by least squares, at the points."""
    f_p, at = data.physics(data.X), data.physics(data.points)
    columns = torch.cat([f_p, torch.ones_like(f_p)], -1)
    found = torch.linalg.lstsq(columns, data.Y, driver="gelsd").solution
    return torch.cat([at, torch.ones_like(at)], -1) @ found


def tables(runs: Sequence[Run], experiment: Functions) -> dict[str, Table]:
    """Return all tables, by name."""
    learners, parts = experiment.axes["learner"], _grouped(runs)
    found = parts["all"] = pd.concat(parts.values())
    worse: dict[str, Cell] = {
        "cells": lambda part: len(_ratios(part, "formula")),
        "error, CKA / formula fitted": _pooled("formula"),
        "median cell": _median("formula"),
        f"cells at most {MOST}": _share,
        "decided": lambda part: sum(
            each.high <= math.log(MOST) for each in _ratios(part, "formula").values()
        ),
        f"cells above {TOO_MUCH}": lambda part: sum(
            each.mean > math.log(TOO_MUCH) for each in _ratios(part, "formula").values()
        ),
        "worst cell": _worst,
    }
    each = {
        f"{label}: {what}": of(column, how, form, learner=name)
        for column, what, how, form in (
            ("error", "median error / sd", "median", ".2g"),
            ("coverage", "95 % coverage", "mean", ".3f"),
            ("nlpd", "median NLPD", "median", ".2f"),
            ("seconds", "s", "median", ".1f"),
        )
        for name, label in learners.items()
        if name != "formula" or column in ("error", "seconds")
    }
    rho: dict[str, Cell] = {
        "cells": lambda part: len(_ratios(part, "phymean")),
        "CKA better": lambda part: sum(e.high < 0 for e in _ratios(part, "phymean").values()),
        "CKA worse": lambda part: sum(e.low > 0 for e in _ratios(part, "phymean").values()),
        "error, CKA / physics mean": _pooled("phymean"),
        "median cell": _median("phymean"),
        "error, CKA / GP": _pooled("gp"),
        "median cell, GP": _median("gp"),
    }
    single = {
        f"CKA / {learners[name]}": ratio_of("error", "cka", name)
        for name in ("formula", "phymean", "gp")
    }
    single["error / sd"] = of("error", "median", ".2g", learner="cka")
    single["95 % coverage"] = of("coverage", "mean", ".2f", learner="cka")
    cells = groups(found, _CELL, "{}, {}".format)
    return {
        "formula": Table(
            "CKA compared with its fitted formula", table(parts, worse, "the formula is")
        ),
        "learners": Table("All learners", table(parts, each, "the formula is")),
        "rho": Table(
            "CKA compared with delta alone, and a GP", table(parts, rho, "the formula is")
        ),
        "cells": Table(
            "Each cell: geometric means of ratios, median error", table(cells, single, "problem, n")
        ),
    }


def _grouped(runs: Sequence[Run]) -> dict[str, pd.DataFrame]:
    found = frame(runs)
    return groups(found.assign(group=found["problem"].map(_GROUP)), "group", GROUPS)


def _ratios(part: pd.DataFrame, other: str) -> dict[tuple[Any, ...], Difference]:
    """Return log ratios of CKA's errors to another's, by cell, paired by data set."""
    cells = {
        cell: paired(own, "error", "learner", "cka", other, ratio=True)
        for cell, own in part.groupby(_CELL, sort=False)
    }
    return {cell: each for cell, each in cells.items() if each.n}


def _pooled(other: str) -> Cell:
    return lambda part: Difference.of([e.mean for e in _ratios(part, other).values()]).ratio()


def _median(other: str) -> Cell:
    def cell(part: pd.DataFrame) -> str:
        means = [each.mean for each in _ratios(part, other).values()]
        return f"{math.exp(np.median(means)):.2f}" if means else ""

    return cell


def _share(part: pd.DataFrame) -> str:
    held = [each.mean <= math.log(MOST) for each in _ratios(part, "formula").values()]
    return f"{sum(held)} of {len(held)}"


def _worst(part: pd.DataFrame) -> str:
    found = _ratios(part, "formula")
    if not found:
        return ""
    cell = max(found, key=lambda cell: found[cell].mean)
    return f"{math.exp(found[cell].mean):.2f}, {cell[0]}, n = {cell[1]}"


def draw(runs: Sequence[Run], experiment: Functions) -> list[Path]:
    """Draw the ratio of each cell to the formula, sorted, with its interval, or a triangle."""
    parts = _grouped(runs)
    figure, axes = panels([*parts], 3, (3.2, 2.8))
    for ax, part in zip(axes, parts.values(), strict=True):
        order = sorted(_ratios(part, "formula").values(), key=lambda each: each.mean)
        middle = np.exp([each.mean for each in order])
        ends = [np.exp([each.low for each in order]), np.exp([each.high for each in order])]
        below = middle < _LEAST_DRAWN
        places, floor = np.arange(len(order)), 1.15 * _LEAST_DRAWN
        ax.vlines(places[~below], *(each[~below] for each in ends), color="0.7", lw=1.5)
        ax.plot(places[~below], middle[~below], ".", color="navy", ms=4)
        ax.plot(places[below], [floor] * below.sum(), "v", color="navy", ms=3)
        ax.axhline(1, color="0.3", lw=0.8)
        ax.axhline(TOO_MUCH, color="tab:red", lw=0.8, ls=":")
        ax.set(yscale="log", ylim=(_LEAST_DRAWN, 4), xlabel="cells, sorted", xticks=[])
        ticks = (0.1, 0.2, 0.5, 1, 2)
        ax.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
    axes[0].set_ylabel("error, CKA / formula fitted")
    return [save(figure, experiment.folder / "functions.png")]
