"""The noise of observations: known variances, or learnt ones with shares that depend on x."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, Self

import torch
from torch import Tensor

from gpadjust.core.data import Data, appended
from gpadjust.core.terms import Places, TermSum
from gpadjust.core.unknowns import LogNormal, Row, Values

_PRIOR = LogNormal(1e-4, 300.0)
_LEAST = 1e-11  # of the squared unit of the targets


class Noise:
    r"""Independent noise of observations, with variances :math:`\sum_k h_k(x) \, v_k`.

    The :math:`v_k` are learnt for each output. A subclass overrides ``shares``, h: one column for
    each name, such as 1 and the square of f_p for a constant standard deviation and a share of f_p.
    If h has numbers of each output, ``of_outputs`` returns the noise of
    some of them.

    Args:
        names: The names of the shares.
        priors: The priors of v, in squared units of the targets (times those of 1 / h).

    Attributes:
        known: Known variances of the training targets, ``... x m x n``, in their unit squared.
    """

    of_targets: tuple[str, ...] = ("known", "shift")
    """Attributes with a number of each training target, ``... x m x n``."""
    shift: Tensor | float = 0.0
    """Mean of the noise of the training targets, ``m x n``, in their unit."""

    def __init__(
        self, names: Sequence[str] = ("variance",), priors: Sequence[LogNormal] | None = None
    ) -> None:
        self.known: Tensor | None = None
        self.names = tuple(names)
        self.priors = [_PRIOR] * len(self.names) if priors is None else [*priors]

    @property
    def has_shares(self) -> bool:
        """Whether the variances depend on x, by :meth:`shares`."""
        return type(self).shares is not Noise.shares

    @property
    def is_outlier(self) -> Tensor | None:
        """Mask ``n x m`` of the training targets that are outliers; None without a search."""
        return None

    def of_data(self, data: Data, terms: TermSum) -> Self:
        """Return the noise for a model's data and terms, as with priors by them; itself here.

        Targets are in the unit ``terms.unit``, ``m x 1``, f_p at the training inputs, ``terms.f``.
        """
        return self

    def shares(self, places: Places) -> Tensor | None:
        """Return h, which broadcasts with ``... x S x m x n x K``; None for a single share of 1."""
        return None

    def rows(self, Y: Tensor) -> list[Row]:
        """Return the unknown variances, for targets ``n x m``."""
        rows = []
        for name, prior in zip(self.names, self.priors, strict=True):
            median = Y.new_full((Y.shape[-1], 1), prior.median)
            rows.append(Row.positive(f"noise.{name}", median, prior.factor))
        return rows

    def variance(self, values: Values, places: Places, is_training: bool = False) -> Tensor:
        """Return the variances, ``... x S x m x n`` (or 1 where all are equal)."""
        # h_1 v_1 + h_2 v_2 + ...
        v = torch.cat([values[f"noise.{name}"] for name in self.names], -1) + _LEAST
        shares = self.shares(places)
        if shares is None:
            if len(self.names) != 1:
                raise ValueError(f"Expected shares for {self}; override the method shares.")
            return v
        if (shares < 0).any():
            raise ValueError(f"Expected shares of {self} that are not negative.")
        variances = (v.unsqueeze(-2) * shares).sum(-1)
        if variances.shape[-2] != v.shape[-2]:
            raise ValueError(
                f"Expected shares of {v.shape[-2]} outputs or of 1; found {variances.shape[-2]}. A "
                "noise with numbers of each output needs the method of_outputs."
            )
        return variances

    def pull_back(self, values: Values, places: Places, by: Tensor) -> Values:
        """Return derivatives by v, of derivatives by the training variances ``S x m x n``."""
        shares = self.shares(places)
        if shares is None:
            return {f"noise.{name}": by.sum(-1, keepdim=True) for name in self.names}
        # df / dv_k = sum_i h_k(x_i) df / dvariance_i
        slopes = (by.unsqueeze(-1) * shares).sum(-2).split(1, -1)
        return {f"noise.{name}": slope for name, slope in zip(self.names, slopes, strict=True)}

    def appended(self, variances: Tensor | None, num_points: int) -> Noise:
        """Return the noise of further rows, too; a ValueError of variances of a learnt one."""
        if variances is not None:
            raise ValueError("Expected no noise, as the model learns it without train_Yvar.")
        return self

    def learnt(self, model: Any, fitted: Callable[[Noise], Any]) -> Noise:
        """Return the noise with what it learns of rows from rough fits; :func:`fit` begins so.

        Args:
            model: The model, before it is fitted.
            fitted: Returns the model with a noise, at its most likely numbers.
        """
        return self

    def with_known(self, known: KnownNoise) -> Noise:
        """Return the noise of targets with known variances; a ValueError if it learns them."""
        raise ValueError(f"Expected train_Yvar or a noise of learnt variances; found both, {self}.")

    def of_outputs(self, outputs: Sequence[int]) -> Self:
        """Return the noise of some outputs."""
        return self.mapped(lambda v: v[..., [*outputs], :], "of_outputs", outputs)

    def to(self, like: Tensor) -> Self:
        """Return the noise on the device of a tensor."""
        return self.mapped(lambda v: v.to(like), "to", like)

    def of_rows(self, rows: Tensor) -> Self | None:
        """Return the noise of some observations, or None if it cannot do with fewer."""
        return self.mapped(lambda v: v[..., rows], "of_rows", rows)

    def mapped(self, change: Callable[[Tensor], Tensor], method: str, *arguments: Any) -> Self:
        """Return the noise with other numbers of targets; a method does it to a noise within."""
        new = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Noise):
                setattr(new, name, getattr(value, method)(*arguments))
            elif name in self.of_targets and isinstance(value, Tensor):
                setattr(new, name, change(value))
        return new

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self.names)})"


class KnownNoise(Noise):
    """Noise of known variances, ``... x m x n``, in squared units of the targets."""

    def __init__(self, variances: Tensor) -> None:
        super().__init__(())
        self.known: Tensor = variances

    def variance(self, values: Values, places: Places, is_training: bool = False) -> Tensor:
        """Return the known variances; at other places their mean in each output."""
        variances = self.known.unsqueeze(-3)  # ... x 1 x m x n
        if is_training:
            return variances
        return variances.mean(-1, keepdim=True)

    def appended(self, variances: Tensor | None, num_points: int) -> Self:
        """Return the noise of further rows, too: of given variances or the mean of those known."""
        if variances is None:
            variances = self.known.mean(-1, keepdim=True).expand(*self.known.shape[:-1], num_points)
        new = copy(self)
        new.known = appended(self.known, variances, -1)
        return new
