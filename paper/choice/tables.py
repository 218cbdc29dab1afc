"""Errors, intervals and targets of models with a physics of no use, and of what `compare` says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from paper.choice import KINDS, METHODS, OF_NO_USE, Choice
from paper.choice.problems import PROBLEMS
from paper.common.claims import Judged, met
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown

_LEAST = 1e-3  # standard deviations of a function: errors below it are alike
_SET = ["problem", "per_input", "seed"]


def tables(records: Sequence[Record], experiment: Choice) -> dict[str, Table]:
    """All tables, by name."""
    runs = pd.DataFrame([{k: v for k, v in r.items() if k != "settings"} for r in records])
    runs["error"] = runs["rmse"].clip(lower=_LEAST)
    return {
        "targets": Table("Targets", claims_table("target", {"": _targets(runs)})),
        "no-use": Table("Physics of no use", _of(runs, OF_NO_USE)),
        "kinds": Table("Kinds of data sets", _of(runs, KINDS)),
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
    methods = [method for method in METHODS if method in {*runs["method"]}]
    for problem in problems:
        for per_input, own in runs[runs["problem"] == problem].groupby("per_input"):
            by = own.groupby("method")
            errors, noise = by["error"].apply(_mean), by["noise"].mean()
            held, measured = by["coverage"].mean(), by["measured"].mean()
            use = own[own["method"] == "cka"]["relevance"].median()
            given = PROBLEMS[problem]
            rows.append(
                [
                    problem,
                    f"{given.num_inputs}",
                    f"{given.num_inputs * int(str(per_input))}",
                    " / ".join(f"{errors[method]:.2g}" for method in methods),
                    " / ".join(f"{held[method]:.2f}" for method in methods),
                    " / ".join(f"{measured[method]:.2f}" for method in methods),
                    f"{given.noise:g}: " + " / ".join(f"{noise[method]:.2g}" for method in methods),
                    f"{use:.2f}",
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
        measured = f"{wrong} of {said}"
        enter("C4", text, wrong <= said / 20, measured)
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
