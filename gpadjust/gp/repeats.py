"""Rows of equal inputs as one observation each, at the cost of the distinct inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from torch import Tensor


class Within(NamedTuple):
    r"""What observations of equal inputs say of their noise, beside their means.

    Of ``n`` observations with the mean :math:`\bar y`, its variance V and their variances
    :math:`v_i = V c / p_i` with :math:`c = \sum_i p_i`,

    .. math::

        \prod_i N(y_i | f, v_i) = N(\bar y | f, V) \, \exp(-\tfrac12 R), \quad
        R = (n - 1) \log 2 \pi V + n \log c - \sum_i \log p_i + S / V,

    with :math:`S = \sum_i p_i (y_i - \bar y)^2 / c`.

    Attributes:
        number: The numbers n, ``... x u``.
        square: S, of the same shape.
        constant: All of R that does not depend on V, of all groups, but for :math:`\log 2 \pi`,
            ``...``.
    """

    number: Tensor
    square: Tensor
    constant: Tensor

    def at(self, variance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Numbers, squares and logarithms that R sums, ``...``, at variances of the means."""
        more = (self.number - 1).clamp_min(0)
        logs = (more * variance.log()).sum(-1) + self.constant
        return more.sum(-1), (self.square / variance).sum(-1), logs

    def slope(self, variance: Tensor, scale: Tensor) -> Tensor:
        """The derivative of R / 2 by the variances, which a factor ``...`` multiplies."""
        more, scale = (self.number - 1).clamp_min(0), scale.unsqueeze(-1)
        return 0.5 * (more - self.square / (variance * scale)) / variance


class Means(NamedTuple):
    """Observations of equal inputs as one each.

    Attributes:
        targets: Their weighted means, ``... x u``; NaN where there is none.
        share: The variance of each mean, in that of an observation of weight 1, ``... x u``.
        weight: The weight of each observation in its mean, ``... x n``; 0 where there is none.
        within: What else they say.
    """

    targets: Tensor
    share: Tensor
    weight: Tensor
    within: Within


@dataclass(eq=False)
class Repeats:
    """Rows of equal inputs.

    Args:
        first: The first row of each of ``u`` distinct inputs, ``u``.
        group: The number of the distinct input of each row, ``n``.
    """

    first: Tensor
    group: Tensor

    @classmethod
    def of(cls, inputs: Tensor) -> Self:
        """The rows of inputs ``... x n x d`` that are equal in all of a batch."""
        n = inputs.shape[-2]
        rows = inputs.reshape(-1, *inputs.shape[-2:]).transpose(0, 1).reshape(n, -1)
        distinct, group = rows.unique(dim=0, return_inverse=True)
        every = torch.arange(n, device=group.device)
        first = every.new_full((len(distinct),), n).scatter_reduce(0, group, every, "amin")
        order = first.argsort()
        return cls(first[order], order.argsort()[group])

    def appended(self, number: int) -> Repeats:
        """Return the same with more rows, each of which counts by itself."""
        n, u = len(self.group), len(self.first)
        more = torch.arange(number, device=self.group.device)
        return Repeats(torch.cat([self.first, n + more]), torch.cat([self.group, u + more]))

    def sum(self, values: Tensor) -> Tensor:
        """Sum values ``... x n`` of each distinct input, ``... x u``."""
        total = values.new_zeros(*values.shape[:-1], len(self.first))
        return total.index_add_(-1, self.group, values)

    def of_rows(self, values: Tensor) -> Tensor:
        """Values ``... x u`` of the rows' inputs, ``... x n``."""
        return values.index_select(-1, self.group)

    def observed(self, targets: Tensor) -> Tensor:
        """The first row of each input that has a target among ``... x n``, if any, ``... x u``."""
        n = targets.shape[-1]
        rows = torch.arange(n, device=targets.device) + n * targets.isnan()
        least = rows.new_full((*rows.shape[:-1], len(self.first)), 2 * n)
        group = self.group.expand(rows.shape)
        return least.scatter_reduce(-1, group, rows, "amin") % n

    def means(self, targets: Tensor, precision: Tensor) -> Means:
        """Average targets ``... x n`` by precisions of the same shape, or what broadcasts to it."""
        observed = ~targets.isnan()
        precision = (precision * observed).expand(targets.shape)
        count, total = self.sum(observed.to(targets)), self.sum(precision)
        known = total.where(count > 0, torch.ones_like(total))
        weight, values = precision / self.of_rows(known), targets.nan_to_num(nan=0.0)
        # About the first, or sums of squares of large numbers would lose digits.
        mean = self.sum(weight * values)
        away = (values - self.of_rows(mean)) * observed
        mean = mean + self.sum(weight * away)
        away = (values - self.of_rows(mean)) * observed
        logs = precision.where(observed, torch.ones_like(precision)).log().sum(-1)
        within = Within(
            count, self.sum(weight * away.square()), (count * known.log()).sum(-1) - logs
        )
        mean = mean.where(count > 0, torch.nan)
        return Means(mean, known.reciprocal(), weight, within)

    def of_each(
        self, means: Means, targets: Tensor, variance: Tensor, alpha: Tensor, precision: Tensor
    ) -> tuple[Tensor, Tensor]:
        r"""Weights and precisions of the rows by those of the means.

        With :math:`W = 1 / V`, a group's weight :math:`\alpha` and diagonal entry :math:`\kappa` of
        the inverse covariance, those of a row with the share w of its mean are
        :math:`w \alpha + w W (y_i - \bar y)` and :math:`w W (1 - w) + w^2 \kappa`.

        Args:
            means: The means.
            targets: Those of the rows, ``... x n``.
            variance: V, ``... x u``.
            alpha: ``... x u``.
            precision: ``... x u``.
        """
        weight = means.weight
        each = weight / self.of_rows(variance)
        away = (targets - self.of_rows(means.targets)).nan_to_num(nan=0.0)
        alpha = weight * self.of_rows(alpha) + each * away
        return alpha, each * (1 - weight) + weight.square() * self.of_rows(precision)
