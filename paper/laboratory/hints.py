"""Are hints given where data are of a kind, and not where they are clean?

Thresholds were set on the seeds 200 to 205 of 15 pairs, with five and ten points for each input, of
1,116 data sets (robust standard deviations that an outlier is off, and its own predicted ones):

| outlier if beyond | hint of clean data | hint where there is an outlier |
|---|---|---|
| 6 and 2.5 | 0.003 | 0.43 |
| 6 and 3 | 0.000 | 0.36 |
| 8 and 3 | 0.000 | 0.24 |
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from gpadjust import compare
from paper.common.experiment import Run, Table
from paper.common.tables import frame, groups, of, table
from paper.laboratory import Hints
from paper.pairs.functions import Pair, observations, pair

POINTS = 40
SAYS = {
    "outliers": "farther from the prediction",
    "relative": "residuals grow",
    "positive": "cannot be negative",
    "decades": "spans",
    "rigs": "names rather than sizes",
}


def data_of(found: Pair, kind: str, seed: int) -> tuple[Tensor, Tensor, bool]:
    """Inputs and observations, and whether these, as f_p, are over decades."""
    X, Y = observations(found, POINTS, seed)
    draw = torch.Generator().manual_seed(seed)
    white = torch.randn(POINTS, 1, generator=draw, dtype=torch.float64)
    if kind in ("decades", "relative"):
        Y = _bent(found, Y)
        return X, Y + 0.15 * white * (Y if kind == "relative" else Y.median()), True
    noise = 0.0 if kind == "exact" else 0.05 * float(Y.std())
    Y = Y + noise * white
    if kind == "outliers":
        rows = torch.randperm(POINTS, generator=draw)[: POINTS // 20]
        size, sign = torch.rand(2, len(rows), 1, generator=draw, dtype=torch.float64)
        Y[rows] += noise * 10 ** (1 + size) * (sign - 0.5).sign()
    if kind == "rigs":
        rig = torch.randint(4, (POINTS, 1), generator=draw)
        X = torch.cat([X, rig.double()], dim=-1)
    return X, Y, False


def _bent(found: Pair, values: Tensor) -> Tensor:
    """Values of a pair, over some three decades."""
    typical = found.truth(found.sobol(512, 7))
    return 5 * (1.5 * (values - typical.mean()) / typical.std()).exp()


def run(experiment: Hints, data: str, problem: str, seed: int) -> Run:
    """Compare, and return how often each hint is given."""
    warnings.simplefilter("ignore")
    found = pair(problem)
    X, Y, is_bent = data_of(found, data, seed)
    f_p = found.physics()

    def physics(X: Tensor) -> Tensor:
        values = f_p(X[:, : found.d])
        return _bent(found, values) if is_bent else values

    hints = compare(X, Y, physics, seed=seed).hints
    return {"given": {name: sum(words in each for each in hints) for name, words in SAYS.items()}}


def tables(runs: Sequence[Run], experiment: Hints) -> dict[str, Table]:
    """The share of data sets with each hint."""
    rows = frame([{**each, **each["given"]} for each in runs])
    columns = {"data sets": lambda part: str(len(part))}
    columns |= {name: of(name, form=".2f") for name in SAYS}
    by_kind = groups(rows, "data", experiment.axes["data"])
    return {"given": Table("Share of data sets with a hint", table(by_kind, columns, "data"))}
