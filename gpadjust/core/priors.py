"""The table of the priors of a model, which draws itself."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from pandas import DataFrame
from torch import Tensor

from gpadjust.core.summary import numbers_of
from gpadjust.display import Display

_LEVELS = 2001  # of which 0.025, 0.5 and 0.975 are some


class Priors(Display, DataFrame):
    """A frame of unknown numbers by their priors; ``plot()`` draws these, and the posterior.

    Attributes:
        prior: Draws of each number from its prior, in the order of the rows.
        posterior: Draws of the fit likewise; None before it.
    """

    _metadata: ClassVar[list[str]] = ["prior", "posterior"]
    prior: list[Tensor]
    posterior: list[Tensor] | None


@torch.no_grad()
def priors(model: Any) -> Priors:
    """Return the priors of all numbers of the whole model, in the user's units."""
    table = model.table
    if table.has_other_priors:
        u = table.prior_draws(2 * _LEVELS, 0)
    else:  # each number rises with its coordinate
        levels = torch.linspace(0, 1, _LEVELS).to(model.u).clamp(1e-4, 1 - 1e-4)
        u = torch.special.ndtri(levels).reshape(-1, 1, 1).expand(-1, table.problems, table.size)
    ends = torch.tensor([0.5, 0.025, 0.975]).to(model.u)
    numbers = numbers_of(model, table.with_choice(u, 0))
    rows = [
        [number.name, output, *number.draws.quantile(ends).tolist(), number.meaning]
        for (output, _), number in numbers.items()
    ]
    frame = Priors(rows, columns=["name", "output", "median", "2.5 %", "97.5 %", "meaning"])
    frame.prior = [number.draws for number in numbers.values()]
    frame.posterior = None
    if model.is_fitted:
        frame.posterior = [number.draws for number in numbers_of(model, model.draws).values()]
    return frame
