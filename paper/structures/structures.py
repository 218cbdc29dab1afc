"""What CKA loses to the models that it contains, and RRA to CKA, by the library's defaults."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
from torch import Tensor

from gpadjust import fit
from gpadjust.core import GP, FitResult
from gpadjust.dynamics import LearnedDynamics
from paper.common.experiment import Run, Table
from paper.common.learners import LEARNERS
from paper.common.runs import timed
from paper.common.tables import Cell, claims_table, frame, table
from paper.common.verdicts import Difference, Judged, Verdict, all_of, paired, within
from paper.structures import CELLS, GROUPS, MODELS, PUMP, Structures, label
from paper.structures.data import Data, of_pair, pump, scored
from paper.structures.systems import System, system

MOST_RMSE = 1.1  # in those of the better of physics mean and GP
MOST_NLPD = 0.15  # nats above the better of them
_CONTAINED = ["phy", "gp"]
_CELL = ["problem", "size", "noise"]


def run(
    experiment: Structures, problem: str, size: int, noise: float, model: str, seed: int
) -> Run:
    """Fit one model to one data set; return scores, those of each output in a list."""
    _prepare(model)
    settings = experiment.settings
    if GROUPS[problem] != "functions":
        return _of_system(system(problem, size, settings.num_transitions, seed), model)
    if problem == PUMP[0]:
        return _of_function(pump(settings.num_pump, seed), model, seed)
    return _of_function(of_pair(problem, size, noise, settings.num_test, seed), model, seed)


def _make(name: str) -> Callable[..., GP]:
    return LEARNERS["phymean" if name == "phy" else name].make


def _of_function(data: Data, name: str, seed: int) -> Run:
    """Scores of each output, as those of calibration."""
    (model, result), found = timed(lambda: _fitted(data, name), time.perf_counter)
    scores = scored(model, data, seed)
    parts = (scores[score] for score in ("nrmse", "nlpd", "coverage"))
    return {"N": len(data.X), **_scores(*parts), "effective": result.effective, **found}


def _fitted(data: Data, name: str) -> tuple[GP, FitResult]:
    model = _make(name)(data.X, data.Y, physics=data.physics)
    return model, fit(model)


def _of_system(data: System, name: str) -> Run:
    """Scores of each state's change in one step, as the mean and variance of dynamics tell it."""

    def learnt() -> LearnedDynamics:
        physics = None if name == "gp" else data.physics
        dynamics = LearnedDynamics(data.spec, physics, model=_make(name))
        dynamics.update(*data.train)
        return dynamics

    dynamics, found = timed(learnt, time.perf_counter)
    scores = dynamics.score(*data.test)
    change = data.spec.change(data.test.states, data.test.next_states)[:, data.spec.moving]
    sd = change.std(0)
    return {
        "N": len(data.train.states),
        **_scores(scores.rmse / sd, scores.nlpd - sd.log(), scores.coverage),
        "effective": dynamics.fit_result.effective if dynamics.fit_result else None,
        **found,
    }


def _scores(nrmse: Tensor, nlpd: Tensor, coverage: Tensor) -> Run:
    """Over the outputs, and of each."""
    each = {"nrmse": nrmse.tolist(), "nlpd": nlpd.tolist(), "coverage": coverage.tolist()}
    return {
        "nrmse": nrmse.log().mean().exp().item(),
        "nlpd": nlpd.mean().item(),
        "coverage": coverage.mean().item(),
        "each": each,
    }


@cache
def _prepare(name: str) -> None:
    """Set a process up: one fit that is not timed."""
    _fitted(of_pair("forrester", 5, 0.0, 10, 4), name)


def cells(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each cell that all models have run in.

    Columns ``"label"``, ``"group"``, ``"seeds"``, their number, and ``"best"``, the better one's
    RMSE of physics mean and GP; then ``(score, model)`` of ``"nrmse"``, the median over the seeds
    in units of that, ``"nlpd"``, the mean less the better one's, ``"coverage"`` and ``"warned"``,
    means, and ``"seconds"``, a median.
    """
    scored = frame(runs)
    by_cell = scored.groupby([*_CELL, "model"], sort=False)
    middle = by_cell[["nrmse", "seconds"]].median().unstack()
    mean = by_cell[["nlpd", "coverage", "warned"]].mean().unstack()
    found = pd.concat([middle, mean], axis=1).dropna()
    order = dict.fromkeys([*CELLS, *found.index])  # beside the known ones those of smaller trials
    found = found.loc[[cell for cell in order if cell in found.index]]
    best = found["nrmse"][_CONTAINED].min(axis=1)
    least = found["nlpd"][_CONTAINED].min(axis=1)
    for model in MODELS:
        found["nrmse", model] /= best
        found["nlpd", model] -= least
    sizes = scored.groupby(_CELL, sort=False).agg(N=("N", "first"), seeds=("seed", "nunique"))
    sizes = sizes.reindex(found.index)
    found["seeds"], found["best"] = sizes["seeds"], best
    found["group"] = [GROUPS[name] for name, *_ in found.index]
    found["label"] = [
        label(name, n, noise) for (name, _, noise), n in zip(found.index, sizes["N"], strict=True)
    ]
    return found


def tables(runs: Sequence[Run], experiment: Structures) -> dict[str, Table]:
    """All tables, by name."""
    found = cells(runs)
    beside = "that of the better of physics mean and GP"
    return {
        "claims": Table("Claim of the paper", claims_table("claim", {"": [judge_intervals(runs)]})),
        "summary": Table("CKA beside the better of physics mean and GP", summary(found)),
        "nrmse": Table(f"Median RMSE / {beside}", _by_model(found, "nrmse", ".2f", MOST_RMSE)),
        "nlpd": Table(
            f"Mean NLPD less {beside}, nats", _by_model(found, "nlpd", "+.2f", MOST_NLPD)
        ),
        "coverage": Table("Mean coverage of 95 %", _by_model(found, "coverage", ".2f")),
        "seconds": Table("Median seconds of a fit", _by_model(found, "seconds", ".2g")),
        "rho": Table("CKA beside its delta alone, on the same data sets", rho(runs)),
    }


def _by_group(found: pd.DataFrame) -> dict[str, pd.DataFrame]:
    return {name: found[found["group"] == name] for name in dict.fromkeys(found["group"])}


def judge_intervals(runs: Sequence[Run]) -> Judged:
    """U1, the claim of the paper's abstract, over the cells: all models by the default fit."""
    text = "CKA and RRA quantify uncertainty more accurately than GP"
    names = ("cka", "rra", "gp")
    coverage, density = (
        frame(runs).groupby([*_CELL, "model"])[score].mean().unstack()
        for score in ("coverage", "nlpd")
    )
    if not {*names} <= {*coverage}:
        return Judged("U1", text, "not run", "not all models were run")
    found: list[Verdict] = []
    for score in ((coverage - 0.95).abs(), density):
        gaps = [Difference.of(score[one] - score["gp"]) for one in ("cka", "rra")]
        found.append(all_of(*(within(gap, high=0) for gap in gaps)))
    said = "95 % hold " + ", ".join(f"{MODELS[name]} {coverage[name].mean():.2f}" for name in names)
    said += f"; by coverage {found[0]}, by NLPD {found[1]}"
    return Judged("U1", text, found[0] if found[0] == found[1] else "undetermined", said)


def _ratio(part: pd.DataFrame, model: str = "cka", other: str | None = None) -> float:
    """The geometric mean of RMSEs, in units of the better one of physics mean and GP, or other."""
    of = part["nrmse", model] / (1 if other is None else part["nrmse", other])
    return float(np.exp(np.log(of).mean()))


def summary(found: pd.DataFrame) -> str:
    """In how many cells CKA holds both limits, and the means, by group."""

    def close(part: pd.DataFrame) -> Any:
        return part["nrmse", "cka"] <= MOST_RMSE

    def sure(part: pd.DataFrame) -> Any:
        return part["nlpd", "cka"] <= MOST_NLPD

    def both(part: pd.DataFrame) -> str:
        held = close(part) & sure(part)
        return f"{held.sum()} of {len(part)} ({held.mean():.0%})"

    def rmse(model: str) -> Cell:
        return lambda part: f"{_ratio(part, model):.2f}"

    def nlpd(model: str) -> Cell:
        return lambda part: f"{part['nlpd', model].mean():+.2f}"

    columns: dict[str, Cell] = {
        "CKA holds both limits": both,
        f"RMSE to {MOST_RMSE}": lambda part: close(part).sum(),
        f"NLPD to +{MOST_NLPD}": lambda part: sure(part).sum(),
        **{f"RMSE, {label}": rmse(model) for model, label in MODELS.items()},
        **{f"NLPD, {label}": nlpd(model) for model, label in MODELS.items()},
        "CKA: 95 % hold": lambda part: f"{part['coverage', 'cka'].mean():.3f}",
        "RMSE, RRA / CKA": lambda part: f"{_ratio(part, 'rra', 'cka'):.2f}",
    }
    return table(_by_group(found) | {"all": found}, columns, "cells")


def _by_model(found: pd.DataFrame, column: str, form: str, most: float | None = None) -> str:
    """A row for each cell; what of CKA is beyond the limit is bold."""

    def cell(model: str) -> Cell:
        def text(row: pd.DataFrame) -> str:
            value = row[column, model].iloc[0]
            is_beyond = model == "cka" and most is not None and value > most
            return f"**{value:{form}}**" if is_beyond else f"{value:{form}}"

        return text

    rows = {name: found.iloc[[i]] for i, name in enumerate(found["label"])}
    return table(rows, {label: cell(model) for model, label in MODELS.items()})


def rho(runs: Sequence[Run]) -> str:
    """Whether CKA is better than the physics mean, its delta alone, over all kinds of data sets.

    Errors are compared on the same data sets; a cell is one problem with one number of data.
    """
    own = frame(runs).assign(group=lambda r: r["problem"].map(GROUPS))
    own["cell"] = own[_CELL].astype(str).agg(", ".join, axis=1)
    groups = {f"{name}, default fit": part for name, part in own.groupby("group", sort=False)}
    columns: dict[str, Cell] = {
        "cells": lambda part: part["cell"].nunique(),
        "CKA better": lambda part: sum(each.high < 0 for each in _gaps(part)),
        "CKA worse": lambda part: sum(each.low > 0 for each in _gaps(part)),
        "error, CKA / physics mean": lambda part: Difference.of(
            [each.mean for each in _gaps(part)]
        ).ratio(),
        "median cell": lambda part: f"{np.exp(np.median([g.mean for g in _gaps(part)])):.2f}",
        "NLPD, CKA less physics mean, median cell": lambda part: (
            f"{np.median([gap.mean for gap in _gaps(part, 'nlpd', ratio=False)]):+.2f}"
        ),
    }
    return table(groups, columns, "data sets")


def _gaps(part: pd.DataFrame, value: str = "nrmse", ratio: bool = True) -> list[Difference]:
    """CKA less physics mean, cell by cell, paired by data set."""
    found = [
        paired(own, value, "model", "cka", "phy", ratio=ratio) for _, own in part.groupby("cell")
    ]
    return [each for each in found if each.n]
