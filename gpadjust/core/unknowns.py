"""Unknown numbers: each is a standard normal coordinate u by its prior, whatever it stands for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import NamedTuple

import torch
from torch import Tensor

Values = dict[str, Tensor]
"""Numbers by the names of their rows: ``S x m x k``, of shared rows ``S x k``."""

_CHOICE = "choice"


def standard_normal(shape: Sequence[int], generator: torch.Generator, like: Tensor) -> Tensor:
    """Return draws from N(0, 1), the same on every device."""
    return torch.randn(*shape, generator=generator, dtype=like.dtype).to(like)


class LogNormal(NamedTuple):
    """The prior of a positive number."""

    median: float
    factor: float  # by which one standard deviation multiplies or divides; 1 of a fixed number


class Row(NamedTuple):
    r"""Unknown numbers of one name: a row of the table of a model.

    A number is :math:`\theta = a + b u`, or :math:`e^{a + b u}` if it is positive, so that it is
    normal or log-normal where its coordinate is :math:`u \sim N(0, 1)`. A log prior density of the
    numbers, ``... x k`` to ``...``, replaces this prior, which then only scales the coordinate.
    """

    name: str  # such as "delta.kernel.lengthscale"
    location: Tensor  # a, m x k, for each output; k if all outputs share the numbers
    scale: float = 1.0  # b
    is_positive: bool = False
    is_shared: bool = False
    log_density: Callable[[Tensor], Tensor] | None = None

    @classmethod
    def positive(cls, name: str, median: Tensor, factor: float) -> Row:
        """Return a row of positive numbers, with medians ``m x k`` and the factor of one sd."""
        return cls(name, median.log(), math.log(factor), is_positive=True)

    def value(self, u: Tensor) -> Tensor:
        """Return the numbers at coordinates ``S x m x k`` (of a shared row ``S x k``)."""
        theta = self.location + self.scale * u  # a + b u
        if self.is_positive:
            theta = theta.exp()
        return theta

    def coordinate(self, value: Tensor) -> Tensor:
        """Return the coordinates of numbers."""
        if self.is_positive:
            value = value.log()
        return (value - self.location) / self.scale  # u = (theta - a) / b

    def slope(self, value: Tensor) -> Tensor | float:
        """Return the derivatives of the numbers by their coordinates."""
        # d theta / du = b, or b theta.
        return self.scale * value if self.is_positive else self.scale


class Choice(NamedTuple):
    """One of several nested models: the whole model with some numbers set to zero.

    ``zeros`` are names of numbers, such as ``"rho.constant"``, or the prior mean of a term or its
    process without the constant, ``"rho.mean"``, ``"rho.process"``.
    """

    text: str  # the meaning, for summaries
    probability: float  # the prior one
    zeros: tuple[str, ...] = ()


class Table:
    r"""All unknown numbers of a model, and vectors of their coordinates.

    Vectors u are ``S x B x P``: ``S`` draws of the coordinates of ``B`` independent problems, ``B =
    m`` outputs, or 1 if these share numbers. With choices, the last coordinate of each output
    selects the nested model: an interval of ``|u|``, of which the first choice has the lowest. It
    has no gradient; :meth:`with_choice` sets it.

    Attributes:
        problems: ``B``.
        size: ``P``.
        rows: Those of each output, ``own``, then those that outputs share, ``shared``.
    """

    def __init__(
        self, rows: Sequence[Row], num_outputs: int, choices: Sequence[Choice] = ()
    ) -> None:
        self.choices = tuple(choices)
        self.num_outputs = num_outputs
        self.own = [row for row in rows if not row.is_shared]
        self.shared = [row for row in rows if row.is_shared]
        if self.choices:
            self.own.append(Row(_CHOICE, self.own[0].location.new_zeros(num_outputs, 1)))
        self.rows = (*self.own, *self.shared)
        self.problems = 1 if self.shared else num_outputs
        self._sizes = [row.location.shape[-1] for row in self.rows]
        self._width = sum(self._sizes[: len(self.own)])
        self._own_size = self._width * (num_outputs // self.problems)
        self.size = self._own_size + sum(self._sizes[len(self.own) :])
        self.has_other_priors = any(row.log_density is not None for row in rows)
        shares = torch.tensor([c.probability for c in self.choices] or [1.0], dtype=torch.float64)
        if len(self.choices) == 1 or abs(shares.sum() - 1) > 1e-9 or (shares <= 0).any():
            expected = "several choices with positive probabilities that sum to 1"
            raise ValueError(f"Expected {expected}; found {shares.tolist()}.")
        self.log_prior = shares.log()
        # P(|u| < end) is the probability of the choices up to one.
        self._ends = torch.special.ndtri((1 + shares.cumsum(0)[:-1]) / 2)

    def values(self, u: Tensor) -> Values:
        """Return all numbers at coordinates ``S x B x P``."""
        parts: list[Tensor] = []
        if self.own:
            parts += self._of_outputs(u).split(self._sizes[: len(self.own)], -1)
        if self.shared:
            parts += u[:, 0, self._own_size :].split(self._sizes[len(self.own) :], -1)
        values = {row.name: row.value(z) for row, z in zip(self.rows, parts, strict=True)}
        if self.choices:
            chosen = self.chosen(values).unsqueeze(-1)
            for k in chosen.unique().tolist():
                for name in self.choices[k].zeros:
                    value = values.get(name, torch.ones_like(values[_CHOICE]))
                    values[name] = value.masked_fill(chosen == k, 0.0)
        return values

    def with_values(self, u: Tensor, values: Values) -> Tensor:
        """Return coordinates ``S x B x P`` by which numbers of outputs have these values."""
        parts = [*self._of_outputs(u).split(self._sizes[: len(self.own)], -1)]
        for i, row in enumerate(self.own):
            if row.name in values:
                parts[i] = row.coordinate(values[row.name]).expand_as(parts[i])
        own_part = torch.cat(parts, -1).reshape(*u.shape[:2], self._own_size)
        return torch.cat([own_part, u[..., self._own_size :]], -1)

    def _of_outputs(self, u: Tensor) -> Tensor:
        """Return the coordinates of each output, ``S x m x k``."""
        return u[..., : self._own_size].reshape(len(u), self.num_outputs, self._width)

    def gradient(self, by: Values, values: Values) -> Tensor:
        """Return derivatives by u, ``S x B x P``, of derivatives by the numbers."""
        number = len(next(iter(values.values())))
        parts = []
        for row in self.rows:
            slope = row.location.new_zeros(number, *row.location.shape)
            if row.name in by:
                # df / du = (d theta / du) df / d theta
                slope = (row.slope(values[row.name]) * by[row.name]).reshape(slope.shape)
            parts.append(slope)
        slopes = [part.unsqueeze(1) for part in parts[len(self.own) :]]
        if self.own:
            joined = torch.cat(parts[: len(self.own)], -1)
            slopes.insert(0, joined.reshape(number, self.problems, self._own_size))
        return torch.cat(slopes, -1)

    def log_prior_ratio(self, u: Tensor) -> Tensor:
        r"""Return the log density of other priors than N(0, I) over N(0, I), ``S x B``."""
        values = self.values(u)
        total = u.new_zeros(len(u), self.problems)
        for row in self.rows:
            if row.log_density is not None:
                theta = values[row.name]
                size, a_plus_bu = torch.zeros_like(theta), theta
                if row.is_positive:
                    size = a_plus_bu = theta.log()
                z = (a_plus_bu - row.location) / row.scale
                # log p(theta) + log |d theta / du| - log N(u | 0, 1), d theta / du = b theta or b
                size = size + math.log(row.scale) + 0.5 * z.square() + 0.5 * math.log(2 * math.pi)
                part = row.log_density(theta) + size.sum(-1)
                part = part.reshape(len(u), -1)  # S x m, or S x 1 of a shared row
                if self.problems == 1:
                    part = part.sum(-1, keepdim=True)
                total = total + part
        return total

    def prior_draws(self, number: int, seed: int) -> Tensor:
        """Return coordinates ``number x B x P`` of draws from the prior."""
        generator = torch.Generator().manual_seed(seed)
        like = self.rows[0].location
        u = standard_normal((number, self.problems, self.size), generator, like)
        if not self.has_other_priors:
            return u
        # Draws from N(0, I) are resampled by p(u) / N(u | 0, I).
        weights = self.log_prior_ratio(u).nan_to_num(neginf=-1e300).softmax(0)
        problems = [w.multinomial(number, True, generator=generator) for w in weights.mT]
        return torch.stack([u[rows, b] for b, rows in enumerate(problems)], 1)

    def of_outputs(self, outputs: Sequence[int]) -> Table:
        """Return the table of some outputs."""
        rows = [row._replace(location=row.location[outputs]) for row in self.own]
        return self._with_rows([*rows, *self.shared], len(outputs))

    def coordinates_of_outputs(self, u: Tensor, outputs: Sequence[int]) -> Tensor:
        """Return the coordinates ``S x B x P`` of some outputs."""
        parts = self._of_outputs(u)[:, outputs]
        if not self.shared:
            return parts
        return torch.cat([parts.flatten(1).unsqueeze(1), u[..., self._own_size :]], -1)

    def to(self, like: Tensor) -> Table:
        """Return the table on the device of a tensor."""
        rows = [row._replace(location=row.location.to(like)) for row in self.rows]
        return self._with_rows(rows, self.num_outputs)

    def _with_rows(self, rows: Sequence[Row], num_outputs: int) -> Table:
        return Table([row for row in rows if row.name != _CHOICE], num_outputs, self.choices)

    # Nested models.

    def chosen(self, values: Values) -> Tensor:
        """Return the number of the choice of each draw and output, ``S x m``."""
        u = values[_CHOICE].detach().squeeze(-1)
        return torch.bucketize(u.abs(), self._ends.to(u))

    def with_choice(self, u: Tensor, number: int) -> Tensor:
        """Return coordinates with the given choice for all outputs."""
        if not self.choices:
            return u
        middle = 0.0
        if number:  # the middle of the choice's interval of |u|, by probability
            ends = [0.5, *torch.special.ndtr(self._ends).tolist(), 1.0]
            middle = NormalDist().inv_cdf((ends[number] + ends[number + 1]) / 2)
        columns = torch.arange(self._width - 1, self._own_size, self._width, device=u.device)
        return u.index_fill(-1, columns, middle)
