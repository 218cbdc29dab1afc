"""CKA, AR1 and MFK on pairs that are nearly polynomials: errors, intervals, times, and targets."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust.validation import rmse
from paper.common.experiment import Run, Table
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, across, exact_mean, frame, groups, markdown, of, table
from paper.common.verdicts import met
from paper.pairs import POLYNOMIALS, Polynomials
from paper.pairs.functions import Pair, low_inputs, observations, pair
from paper.pairs.multifidelity import SMTModel, quietly_fitted

_CENTRAL = 1.959964  # standard deviations, within which 95 % of a normal distribution lie
_LEAST = 1e-4  # sd of the truth: errors below it are alike
_METHODS: Any = Polynomials.axes["method"]


@cache
def _prepare(method: str, num_low: int) -> None:
    """Set a process up: one fit of the method that is not timed."""
    small = pair("forrester")
    _fitted(method, small, *observations(small, 5, 0), num_low, 0)


def run(experiment: Polynomials, name: str, n: int, method: str, seed: int) -> Run:
    """Train a method on a data set; return its scores, in units of the truth's sd."""
    settings, problem = experiment.settings, pair(name)
    _prepare(method, settings.num_low)
    X, Y = observations(problem, n, seed)
    test_X = problem.sobol(settings.num_test, seed=0)
    test_Y = problem.truth(test_X)
    start = time.process_time()
    model = _fitted(method, problem, X, Y, settings.num_low, seed)
    seconds = time.process_time() - start
    with torch.no_grad():
        if isinstance(model, SMTModel):
            posterior = model.posterior(test_X)
            mean, away = posterior.mean, _CENTRAL * posterior.variance.sqrt()
            lower, upper = mean - away, mean + away
        else:
            mean, (lower, upper) = model.predict(test_X).mean, model.interval(test_X)
    sd = test_Y.std()
    inside = (lower <= test_Y) & (test_Y <= upper)
    return {
        "nrmse": (rmse(mean, test_Y) / sd).item(),
        "coverage": inside.double().mean().item(),
        "width": ((upper - lower).mean() / sd).item(),
        "seconds": seconds,
    }


def _fitted(method: str, pair: Pair, X: Tensor, Y: Tensor, num_low: int, seed: int) -> Any:
    """A model by one of the methods; AR1 and MFK have the same samples of the low level."""
    low_X, physics = low_inputs(pair, X, max(num_low * pair.d, len(X)), seed), pair.physics()
    if method == "mfk":
        return SMTModel(low_X, physics(low_X), X, Y)
    options = {"low_X": low_X} if method == "ar1" else {}
    model = LEARNERS[method.removesuffix("-map")].make(X, Y, physics=physics, **options)
    return quietly_fitted(model, "map" if method == "cka-map" else "bayes")


def tables(runs: Sequence[Run], experiment: Polynomials) -> dict[str, Table]:
    """All tables, by name."""
    found = frame(runs)
    found["log"] = found["nrmse"].clip(lower=_LEAST).map(np.log)
    is_polynomial = np.array(
        [POLYNOMIALS.get(p) == n for p, n in zip(found["pair"], found["n"], strict=True)]
    )
    ours, textbook = found[is_polynomial], found[~is_polynomial]
    title = "Geometric mean of RMSE / sd of the truth; 95 % hold; CPU seconds"
    shown = {
        "targets": Table("Targets", markdown(["", "target", ""], _targets(ours, found))),
        "pairs": Table(title, _by_pair(ours)),
    }
    if len(textbook):
        shown["textbook"] = Table(f"{title}: textbook pairs", _by_pair(textbook))
    return shown


def _by_pair(runs: pd.DataFrame) -> str:
    def columns(cell: Cell) -> dict[str, Cell]:
        return across(runs, "method", _METHODS, cell)

    def error(part: pd.DataFrame) -> str:
        return f"{np.exp(exact_mean(part['log'])):.2g} ({exact_mean(part['coverage']):.2f})"

    rows = groups(runs, ["pair", "n"], "{}, N = {}".format)
    found = table(rows, columns(error), "RMSE / sd (95 % hold)")
    held = table({"95 % hold, mean": runs}, columns(of("coverage", "mean", ".2f")))
    seconds = table({"CPU seconds, median": runs}, columns(of("seconds", "median", ".2g")))
    return "\n".join([found, *(part.splitlines()[-1] for part in (held, seconds))])


def _ratios(runs: pd.DataFrame, method: str) -> pd.Series[float]:
    """Logarithms of the error over MFK's, by pair and size, on the same data sets."""
    logs = runs.pivot_table(index=["pair", "n", "seed"], columns="method", values="log", sort=False)
    if not {method, "mfk"} <= {*logs}:
        return pd.Series(dtype=float)
    gap: pd.Series[float] = (logs[method] - logs["mfk"]).dropna()
    return gap.groupby(["pair", "n"], sort=False).mean()


def _targets(ours: pd.DataFrame, runs: pd.DataFrame) -> list[list[str]]:
    rows = []
    cka, ar1 = _ratios(ours, "cka"), _ratios(runs, "ar1")
    if len(cka):
        each: Any = np.exp(cka)
        said = ", ".join(f"{name} {ratio:.2g}" for (name, _), ratio in each.items())
        text = "CKA: error at most twice MFK's on each pair"
        verdict = met(bool((each <= 2).all()))
        rows.append(["N1", text, f"**{verdict}**: mean {np.exp(cka.mean()):.2g}; {said}"])
        held = ours[ours["method"] == "cka"]["coverage"].mean()
        text = "CKA: 95 % hold .90 on the mean of all"
        rows.append(["N2", text, f"**{met(bool(held >= 0.9))}**: {held:.3f}"])
    if len(ar1):
        mean, both = np.exp(ar1.mean()), _ratios(ours, "ar1")
        text = "AR1: error at most 1.1 times MFK's on all pairs, geometric mean"
        parts = f"near-polynomials {np.exp(both.mean()):.2g}"
        rows.append(["N3", text, f"**{met(bool(mean <= 1.1))}**: {mean:.2f}; {parts}"])
    return rows
