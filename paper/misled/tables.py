"""Regrets and targets of searches."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from paper.common.claims import Verdict, met
from paper.common.experiment import Record, Table
from paper.common.tables import markdown
from paper.misled import HELPS, METHODS, MISLEADS, Misled

_LEAST = 0.1  # per cent: regrets below it are alike
_FOUND = 1.0  # per cent: where the optimum counts as found
_LOST = 5.0  # per cent


def tables(records: Sequence[Record], experiment: Misled) -> dict[str, Table]:
    """All tables, by name."""
    runs = pd.DataFrame(records)
    runs["last"] = [regrets[-1] for regrets in runs["regrets"]]
    runs["found"] = [_found(regrets) for regrets in runs["regrets"]]
    methods = [method for method in METHODS if method in {*runs["method"]}]
    groups = runs.groupby(["problem", "method"])
    rows = []
    for problem in MISLEADS + HELPS:
        for method in methods:
            if (problem, method) not in groups.groups:
                continue
            own = groups.get_group((problem, method))
            weights = [w[-1] for w in own["relevance"] if w[-1] is not None]
            last = own["last"]
            rows.append(
                [
                    problem if method == methods[0] else "",
                    METHODS[method],
                    f"{len(own)}",
                    f"{last.median():.2g}",
                    f"{last.max():.2g}",
                    f"{(last > _LOST).sum()}",
                    _trials(own["found"].median()),
                    f"{pd.Series(weights).median():.2g}" if weights else "",
                ]
            )
    header = ["", "", "runs", "median regret, %", "worst, %", "above 5 %", "trials to 1 %", "use"]
    return {
        "targets": Table("Targets", markdown(["", "target", ""], _targets(runs))),
        "regrets": Table("Regret after all trials", markdown(header, rows)),
    }


def _found(regrets: Sequence[float]) -> float:
    """The number of the first trial below 1 %; of a search without one, infinite."""
    return next((i + 1.0 for i, each in enumerate(regrets) if each < _FOUND), float("inf"))


def _trials(number: float) -> str:
    return "never" if number == float("inf") else f"{number:g}"


def _targets(runs: pd.DataFrame) -> list[list[str]]:
    median = runs.groupby(["method", "problem"])["last"].median().clip(lower=_LEAST)
    lost = (runs["last"] > _LOST).groupby([runs["method"], runs["problem"]]).sum()
    found = runs.groupby(["method", "problem"])["found"].median()
    rows = []

    def enter(name: str, text: str, verdict: Verdict, numbers: list[str]) -> None:
        rows.append([name, text, f"**{verdict}**: {', '.join(numbers)}"])

    ours = [method for method in ("zero", "cka") if method in {*runs["method"]}]
    if "stgp" not in {*runs["method"]}:
        return []
    for i, method in enumerate(ours, start=1):
        ratios = {p: median[method, p] / median["stgp", p] for p in MISLEADS if p in median["stgp"]}
        enter(
            f"B{i}",
            f"{METHODS[method]}: median regret at most 1.1 times SingleTaskGP's, f_p misleads",
            met(all(ratio <= 1.1 for ratio in ratios.values())),
            [f"{p} {ratio:.2g}" for p, ratio in ratios.items()],
        )
    for i, method in enumerate(ours, start=3):
        pairs = {p: (lost[method, p], lost["stgp", p]) for p in MISLEADS if p in median["stgp"]}
        enter(
            f"B{i}",
            f"{METHODS[method]}: no run above 5 % where SingleTaskGP has none",
            met(all(own == 0 or other > 0 for own, other in pairs.values())),
            [f"{p} {own} ({other})" for p, (own, other) in pairs.items()],
        )
    if "cka" in ours:
        both = {p: (found["cka", p], found["stgp", p]) for p in HELPS if p in median["stgp"]}
        enter(
            "B5",
            "CKA: at most half of SingleTaskGP's trials to 1 %, f_p helps",
            met(all(own <= 0.5 * other for own, other in both.values())),
            [f"{p} {_trials(own)} ({_trials(other)})" for p, (own, other) in both.items()],
        )
    return rows
