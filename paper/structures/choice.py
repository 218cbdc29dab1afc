"""Errors, intervals and targets of models with a physics of no use, and of what `compare` says."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust import CKA, StackedGP, ZeroMeanGP, compare, fit
from gpadjust.models import TermsGP
from gpadjust.validation import score
from paper.common.experiment import Run, Table
from paper.common.tables import claims_table, frame, markdown
from paper.common.verdicts import Judged, met
from paper.structures import KINDS, OF_NO_USE, Choice
from paper.structures.problems import PROBLEMS

_MANY = 4096  # points that mean and standard deviation of a function are of
_LEAST = 1e-3  # standard deviations of a function: errors below it are alike
_SET = ["problem", "per_input", "seed"]


def run(experiment: Choice, problem: str, per_input: int, method: str, seed: int) -> Run:
    """Fit one data set; return scores, in standard deviations of the function."""
    _prepare()
    given, d = PROBLEMS[problem], PROBLEMS[problem].num_inputs
    mean, sd = _moments(problem)
    generator = torch.Generator().manual_seed(seed)

    def truth(X: Tensor) -> Tensor:
        return ((given.truth(X) - mean) / sd).unsqueeze(-1)

    def physics(X: Tensor) -> Tensor:
        return ((given.physics(X) - mean) / sd).unsqueeze(-1)

    def noisy(values: Tensor) -> Tensor:
        white = torch.randn(values.shape, generator=generator, dtype=torch.float64)
        return values + given.noise * white

    X = SobolEngine(d, scramble=True, seed=seed).draw(per_input * d, dtype=torch.float64)
    Y = noisy(truth(X))
    number = experiment.settings.num_test
    points = SobolEngine(d, scramble=True, seed=1).draw(number, dtype=torch.float64)
    expected = truth(points)
    new = noisy(expected)
    start, found = time.process_time(), dict[str, Any]()
    if method == "compare":
        comparison = compare(X, Y, physics)
        model: TermsGP | StackedGP = comparison.recommended
        found["chosen"] = comparison.chosen
        found["shown"] = comparison.gain["y"].shown
    else:
        model = ZeroMeanGP(X, Y) if method == "zero" else CKA(X, Y, physics=physics)
        relevance = fit(model, "bayes").relevance
        found["relevance"] = None if relevance is None else relevance.item()
    found["seconds"] = time.process_time() - start
    if method == "compare":
        found["single"] = {
            name: _rmse(each, points, expected) for name, each in comparison.models.items()
        }
    with torch.no_grad():
        scored = score(model.posterior(points, observation_noise=True), new)
        variances = [model.components(X[:1], noise)[1] for noise in (True, False)]
    return {
        "rmse": _rmse(model, points, expected),
        "coverage": _held(model, points, expected),
        "measured": _held(model, X, truth(X)),
        "half": _held(model, points, expected, 0.5),
        "nlpd": scored.nlpd.item(),
        "noise": (variances[0] - variances[1]).mean().clamp_min(0).sqrt().item(),
        **found,
    }


@cache
def _prepare() -> None:
    """Set a process up: a fit that is not timed."""
    X = torch.linspace(0, 1, 5, dtype=torch.float64).unsqueeze(-1)
    fit(CKA(X, X, physics=torch.sin))


@cache
def _moments(problem: str) -> tuple[float, float]:
    """Mean and standard deviation of a function."""
    given = PROBLEMS[problem]
    X = SobolEngine(given.num_inputs, scramble=True, seed=0).draw(_MANY, dtype=torch.float64)
    values = given.truth(X)
    return values.mean().item(), values.std().item()


def _rmse(model: TermsGP | StackedGP, X: Tensor, expected: Tensor) -> float:
    return (model.predict(X).mean - expected).square().mean().sqrt().item()


def _held(model: TermsGP | StackedGP, X: Tensor, expected: Tensor, level: float = 0.95) -> float:
    """The share of values of the function within intervals of it."""
    low, high = model.interval(X, level)
    return ((low <= expected) & (expected <= high)).double().mean().item()


def tables(runs: Sequence[Run], experiment: Choice) -> dict[str, Table]:
    """All tables, by name."""
    found = frame(runs)
    found["error"] = found["rmse"].clip(lower=_LEAST)
    return {
        "targets": Table("Targets", claims_table("target", {"": _targets(found)})),
        "no-use": Table("Physics of no use", _of(found, OF_NO_USE)),
        "kinds": Table("Kinds of data sets", _of(found, KINDS)),
    }


def _mean(ratios: pd.Series) -> float:
    """The geometric mean."""
    return float(np.exp(np.log(ratios).mean()))


def _ratios(runs: pd.DataFrame, method: str, other: str) -> pd.Series:
    """Errors by a method over those by another, by data sets."""
    errors = runs.pivot_table(index=_SET, columns="method", values="error")
    if not {method, other} <= {*errors}:
        return pd.Series(dtype=float)
    return (errors[method] / errors[other]).dropna()


def _of(runs: pd.DataFrame, problems: Sequence[str]) -> str:
    """A row for each problem and number of points."""
    rows = []
    methods = [method for method in Choice.axes["method"] if method in {*runs["method"]}]

    def joined(values: pd.Series, form: str) -> str:
        return " / ".join(f"{values[method]:{form}}" for method in methods)

    for problem in problems:
        for per_input, own in runs[runs["problem"] == problem].groupby("per_input"):
            by, given = own.groupby("method"), PROBLEMS[problem]
            number = given.num_inputs * int(str(per_input))
            rows.append(
                [
                    *(problem, f"{given.num_inputs}", f"{number}"),
                    joined(by["error"].apply(_mean), ".2g"),
                    joined(by["coverage"].mean(), ".2f"),
                    joined(by["measured"].mean(), ".2f"),
                    f"{given.noise:g}: " + joined(by["noise"].mean(), ".2g"),
                    f"{own[own['method'] == 'cka']['relevance'].median():.2f}",
                ]
            )
    head = ["", "inputs", "N", "RMSE", "95 % hold", "at measured inputs", "noise", "use"]
    return markdown(head, rows)


def _targets(runs: pd.DataFrame) -> list[Judged]:
    no_use, kinds = (runs[runs["problem"].isin(names)] for names in (OF_NO_USE, KINDS))
    judged = []

    def enter(name: str, text: str, is_met: bool, measured: str) -> None:
        judged.append(Judged(name, text, met(bool(is_met)), measured))

    if len(own := _ratios(no_use, "cka", "zero")):
        found = {n: _mean(r) for n, r in own.groupby("per_input")}
        text = "f_p of no use: RMSE of CKA at most 1.25 times ZeroMeanGP's, geometric mean"
        measured = ", ".join(f"{ratio:.2f} (N = {n} d)" for n, ratio in found.items())
        enter("N1", text, max(found.values()) <= 1.25, measured)
        cka = no_use[no_use["method"] == "cka"]
        noisy = cka[[PROBLEMS[name].noise > 0 for name in cka["problem"]]]
        for number, n in enumerate(found, start=2):
            each = noisy[noisy["per_input"] == n].groupby("problem")["noise"].apply(_mean)
            factors = {name: each[name] / PROBLEMS[name].noise for name in each.index}
            text = f"the same, N = {n} d: noise found within a factor of 1.5"
            is_met = all(1 / 1.5 <= factor <= 1.5 for factor in factors.values())
            measured = ", ".join(f"{k.split(',')[0]} {v:.2f}" for k, v in factors.items())
            enter(f"N{number}", text, is_met, measured)
        held = cka[["coverage", "measured"]].mean()
        text = "the same: intervals of 95 % hold .92 of the function at new, and at measured inputs"
        measured = f"{held['coverage']:.3f}, {held['measured']:.3f}"
        enter("N4", text, held.min() >= 0.92, measured)
    if len(own := _ratios(kinds, "compare", "cka")):
        by_kind = own.groupby("problem").apply(_mean)
        text = "compare: RMSE at most 1.1 times that of CKA, geometric mean, 1.5 times of any kind"
        worst = by_kind.idxmax()
        measured = f"{_mean(own):.3f}, {by_kind.max():.2f} ({worst})"
        enter("C1", text, _mean(own) <= 1.1 and by_kind.max() <= 1.5, measured)
        held = kinds[kinds["method"] == "compare"]["coverage"]
        measured = f"{held.mean():.3f}, least of a set {held.min():.2f}"
        enter("C2", "compare: intervals of 95 % hold .93", held.mean() >= 0.93, measured)
    if len(own := _ratios(no_use, "compare", "zero")):
        text = "compare where f_p is of no use: RMSE at most that of ZeroMeanGP, geometric mean"
        enter("C3", text, _mean(own) <= 1, f"{_mean(own):.3f}")
    both = runs[runs["method"] == "compare"]
    if len(both):
        said, wrong = _said(both)
        text = "compare: what it says clearly is wrong in at most 1 of 20"
        enter("C4", text, wrong <= said / 20, f"{wrong} of {said}")
        seconds = runs.pivot_table(index=_SET, columns="method", values="seconds")
        if {"compare", "cka"} <= {*seconds}:
            times = seconds["compare"] / seconds["cka"]
            text = "compare: at most 4 times the default's time, median"
            enter("C5", text, times.median() <= 4, f"{times.median():.1f}, most {times.max():.1f}")
    return judged


def _said(runs: pd.DataFrame) -> tuple[int, int]:
    """How often something is said for sure, and how often it is wrong.

    That the physics helps (or does harm) is wrong where CKA errs more (less) than the data alone;
    a structure other than CKA that is recommended by itself, where it errs more than 1.1 times as
    much as CKA.
    """
    said = wrong = 0
    for single, shown, chosen in zip(runs["single"], runs["shown"], runs["chosen"], strict=True):
        errors = {name: max(rmse, _LEAST) for name, rmse in single.items()}
        if shown:
            said += 1
            wrong += shown * (errors["zero mean"] - errors["CKA"]) < 0
        if chosen not in ("CKA", "stacked"):
            said += 1
            wrong += errors[chosen] > 1.1 * errors["CKA"]
    return said, int(wrong)
