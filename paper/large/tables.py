"""The table of models of many observations."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from paper.common.experiment import Record, Table
from paper.common.tables import markdown
from paper.large import LEARNERS, PROBLEMS, Large

_WHAT = {
    "variational": "VariationalCKA, `fit`",
    "exact": "CKA, `fit`",
}
_OUTPUTS = {"hartmann6": ("",), "links": (", first", ", second")}


def tables(records: Sequence[Record], experiment: Large) -> dict[str, Table]:
    """All tables, by name."""
    frame = pd.DataFrame(records)
    rows = []
    for problem in PROBLEMS:
        for learner in LEARNERS:
            own = frame[(frame.problem == problem) & (frame.learner == learner)]
            for n, runs in sorted(own.groupby("observations")):
                rows.extend(_rows(problem, learner, int(n), runs))
    header = [
        "",
        "observations (runs)",
        "error of f",
        "intervals of 95 % hold",
        "without the rest",
        "width",
        "noise found (true)",
        "s",
    ]
    return {
        "many": Table("Models of many observations, one thread", markdown(header, rows)),
        "targets": Table("What was asked", _targets(frame, experiment)),
    }


def _rows(problem: str, learner: str, n: int, runs: pd.DataFrame) -> list[list[str]]:
    from paper.large.problem import NOISE

    rows = []
    for i, output in enumerate(_OUTPUTS[problem]):
        without = "" if learner != "variational" else _mean(runs.coverage_without_rest, i, 2)
        rows.append(
            [
                f"{problem}{output}: {_WHAT[learner]}",
                f"{n:,} ({len(runs)})",
                _mean(runs.rmse, i, 4),
                _mean(runs.coverage, i, 2),
                without,
                _mean(runs.width, i, 3),
                f"{_mean(runs.noise_sd, i, 4)} ({NOISE[problem]})",
                f"{runs.seconds.mean():.0f}",
            ]
        )
    return rows


def _mean(column: pd.Series, output: int, digits: int) -> str:
    return f"{column.map(lambda values: values[output]).mean():.{digits}f}"


def _targets(frame: pd.DataFrame, experiment: Large) -> str:
    """Each target with the worst of all runs and outputs."""
    sparse = frame[frame.learner == "variational"]
    rows = []
    if len(sparse):
        seconds = sparse.seconds.max()
        rows.append(["seconds, the slowest run", "300 (two cores)", f"{seconds:.0f} (one thread)"])
        ratios, gaps = [], []
        for problem, own in sparse.groupby("problem"):
            exact = frame[(frame.learner == "exact") & (frame.problem == problem)]
            if not len(exact):
                continue
            most = exact[exact.observations == exact.observations.max()]
            for i in range(len(_OUTPUTS[problem])):
                ours = float(_mean(own.rmse, i, 9))
                ratios.append(ours / float(_mean(most.rmse, i, 9)))
                gaps.append(float(_mean(own.coverage, i, 9)) - float(_mean(most.coverage, i, 9)))
        if ratios:
            rows.append(
                ["error over that of the exact model of the most", "1.2", f"{max(ratios):.2f}"]
            )
            rows.append(
                ["coverage less that of the exact model of the most", "0", f"{min(gaps):+.3f}"]
            )
    return markdown(["worst of all outputs", "asked", "found"], rows)
