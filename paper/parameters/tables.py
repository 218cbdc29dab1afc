"""How often intervals hold what is best and what is true, and how wide they are."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from paper.common.claims import Judged, met
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown, number
from paper.parameters import MODELS, PROBLEMS, Parameters

_RECOMMENDED = "orthogonal"
_BETWEEN = (0.90, 0.98)
_NARROW = 0.5  # of the width of Kennedy and O'Hagan's


def tables(records: Sequence[Record], experiment: Parameters) -> dict[str, Table]:
    """All tables, by name."""
    found = load(records)
    header = ["", "parameter", "cases", "holds the best", "holds the true", "median width"]
    header += ["RMSE", "coverage", "seconds"]
    by_name = {
        problem: Table(PROBLEMS[problem], markdown(header, _rows(found[found.problem == problem])))
        for problem in PROBLEMS
        if (found.problem == problem).any()
    }
    verdicts = claims_table("target", {"parameters": judge(found)})
    return {"targets": Table("Targets", verdicts), **by_name}


def load(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each parameter of each case and model."""
    rows = []
    for record in records:
        for name, (low, high) in record["intervals"].items():
            row = {key: record[key] for key in ("problem", "model", "rmse", "coverage", "seconds")}
            best, true = record["best"][name], record["true"].get(name)
            row |= {"parameter": name, "width": high - low, "best": float(low <= best <= high)}
            rows.append({**row, "true": None if true is None else float(low <= true <= high)})
    return pd.DataFrame(rows)


def judge(found: pd.DataFrame) -> list[Judged]:
    """The verdicts on the targets."""
    low, high = _BETWEEN
    ours = found[found.model == _RECOMMENDED]
    shares = {
        f"{problem}, {parameter}": part["best"].mean()
        for (problem, parameter), part in ours.groupby(["problem", "parameter"], sort=False)
    }
    held = ", ".join(f"{name} {share:.2f}" for name, share in shares.items())
    judged = [
        Judged(
            "I1",
            f"intervals of 95 % by the orthogonal delta hold the best parameters in {low:.2f} to "
            f"{high:.2f} of the cases",
            met(bool(shares) and all(low <= share <= high for share in shares.values())),
            held or "not run",
        )
    ]
    gravity = found[(found.problem == "ball") & (found.parameter == "gravity")]
    vanishing, free = (gravity[gravity.model == name] for name in ("vanishing", "free"))
    if len(vanishing) and len(free):
        ratio = vanishing["width"].median() / free["width"].median()
        share = vanishing["true"].mean()
        judged.append(
            Judged(
                "I2",
                "the ball's true g is held, by an interval at most half as wide as by a free delta",
                met(bool(share >= low and ratio <= _NARROW)),
                f"by a delta that grows as the time cubed: held in {share:.2f}, by a free one in "
                f"{free['true'].mean():.2f}; {ratio:.2f} times as wide",
            )
        )
    return judged


def _rows(found: pd.DataFrame) -> list[list[str]]:
    rows = []
    for model, label in MODELS.items():
        own = found[found.model == model]
        for i, (parameter, part) in enumerate(own.groupby("parameter", sort=False)):
            whole = [number(part["rmse"].median())]
            whole += [
                number(part["coverage"].mean(), ".2f"),
                number(part["seconds"].median(), ".2f"),
            ]
            rows.append(
                [
                    label if i == 0 else "",
                    str(parameter),
                    f"{len(part)}",
                    number(part["best"].mean(), ".2f"),
                    number(part["true"].astype(float).mean(), ".2f", missing="-"),
                    number(part["width"].median()),
                    *(whole if i == 0 else ["", "", ""]),
                ]
            )
    return rows
