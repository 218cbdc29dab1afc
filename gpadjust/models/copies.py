"""Rows that stand in the data twice, as by joined files, told from true repeats."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from gpadjust.models.training_data import TrainingData

_NOISE = 0.01  # of an output's standard deviation, where no repeats differ
_ROUNDING = 1e-9  # of an output's range
_CHANCE = 1e-3  # of so many equal repeats by rounding alone


def warn_of_copies(data: TrainingData, stacklevel: int) -> None:
    r"""Warn of rows that equal an earlier one in all inputs and outputs, to the last bit.

    True repeats differ by their noise, unless outputs are on a coarse grid, as rounded values and
    counts. With the step h of the grid and the standard deviation s of repeats that differ, two of
    them are equal with the probability :math:`h / (2 \sqrt{\pi} s)` at most. There is a warning
    if the chance of as many equal ones as there are is below 0.001. Of a batch of data sets
    nothing is said.

    Args:
        data: The data.
        stacklevel: Of the caller, as ``warnings.warn`` has it.
    """
    if data.X.dim() > 2:
        return
    n, u = len(data.X), len(data.X.unique(dim=0))
    rows = torch.cat([data.X, data.Y.isnan().to(data.X), data.Y.nan_to_num(nan=0.0)], dim=-1)
    distinct = rows.unique(dim=0)
    copies, repeated, chance = n - len(distinct), n - u, 1.0
    if not copies:
        return
    d, m = data.X.shape[-1], data.Y.shape[-1]
    _, group = distinct[:, :d].unique(dim=0, return_inverse=True)
    for output in range(m):
        seen = distinct[:, d + output] == 0
        chance *= _chance(distinct[seen, d + m + output], group[seen])
    binomial = torch.distributions.Binomial(repeated, torch.tensor(chance, dtype=torch.float64))
    counts = torch.arange(copies, repeated + 1, dtype=torch.float64)
    if chance < 1 and binomial.log_prob(counts).exp().sum() < _CHANCE:
        warnings.warn(
            f"{copies} of {n} rows equal an earlier row in all inputs and outputs, to the last "
            "bit. True repeats differ by their noise; a measurement that counts twice makes the "
            "noise too small and intervals too narrow. If files were joined twice, say, drop them: "
            "`frame.drop_duplicates()`, or `rows = np.unique(np.hstack([X, Y]), axis=0, "
            "return_index=True)[1]` and `X[rows], Y[rows]`.",
            stacklevel=stacklevel + 1,
        )


def _chance(values: Tensor, group: Tensor) -> float:
    """The most likely two repeats are to have the same value of an output, by its rounding."""
    if len(values) < 2 or values.min() == values.max():
        return 1.0
    mean = torch.zeros(int(group.max()) + 1).to(values)
    count = mean.index_add(0, group, torch.ones_like(values))
    mean = mean.index_add(0, group, values) / count.clamp_min(1)
    freedom = float((count - 1).clamp_min(0).sum())
    square = float((values - mean[group]).square().sum())
    spread = math.sqrt(square / freedom) if square else _NOISE * float(values.std())
    return min(1.0, _step(values) / (2 * math.sqrt(math.pi) * spread))


def _step(values: Tensor) -> float:
    """The step of the grid that values are on, by Euclid's algorithm; of none, next to nothing."""
    away = (values.unique() - values.min())[1:].tolist()
    least, step = _ROUNDING * away[-1], away[0]
    for each in away:
        rest = each
        while rest > least:
            step, rest = rest, abs(math.remainder(step, rest))
        if step < 10 * least:
            break
    return float(step)
