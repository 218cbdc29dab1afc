"""Larger variances near left-out observations that were missed by more than predicted."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Size, Tensor
from torch.nn import Module

from gpadjust.gp.kernels import RBF, Stationary

_EXPECTED = 1.0  # observations that err as predicted, beside those near a point
_RECENT = 10.0  # likewise, beside those that came by updates


class LocalErrors(Module):
    r"""Ratio of errors near a point to those by a Gaussian process of stationary kernels.

    Where a function has a kink or a jump, as by dry friction or an impact, such a process is too
    sure nearby. With :math:`z_i^2` the squared error of a left-out observation over its predicted
    variance, variances at x are multiplied by

    .. math:: \max\Big(1, \frac{a + \sum_i k(x, x_i) z_i^2}{a + \sum_i k(x, x_i)}\Big),

    with an RBF kernel k of the shortest lengthscale of all terms, input by input, and a = 1.
    Locally weighted conformal prediction (Lei et al. 2018) has such a scale, too, by a model of
    residuals. There is no guarantee here: left-out observations had their say in hyper-parameters.

    What comes by updates was predicted before: where a machine drifts, such errors are larger
    everywhere, and variances are multiplied by a ratio of them, too, with a = 10.

    Args:
        outputs: The batch shape of a model with its outputs last, ``batch_shape x (m)``.
        num_inputs: Number ``d`` of inputs that kernels read.

    Attributes:
        squares: Squared errors of ``n`` left-out observations, in predicted variances,
            ``batch_shape x (m) x n``; none before a fit.
        points: Where they were observed, ``n x d``.
        lengthscale: That of k, ``batch_shape x (m) x 1 x d``.
        recent: The sum of the squared errors of recent observations that came by updates, and their
            number, ``batch_shape x (m) x 2``.
    """

    recent: Tensor
    squares: Tensor
    points: Tensor
    lengthscale: Tensor

    def __init__(self, outputs: Size, num_inputs: int) -> None:
        super().__init__()
        one = torch.ones((), dtype=torch.float64)
        self.register_buffer("recent", one.expand(*outputs, 2) * 0)
        self.register_buffer("squares", one.expand(*outputs, 0).clone())
        self.register_buffer("points", one.expand(0, num_inputs).clone())
        self.register_buffer("lengthscale", one.expand(*outputs, 1, num_inputs).clone())

    @property
    def are_expected(self) -> bool:
        """True if no error is larger than predicted, so that no variance is changed."""
        return bool((self.squares <= 1).all() and (self.recent.diff(dim=-1) >= 0).all())

    def forward(self, x: Tensor, recent: bool = True) -> Tensor:
        """Return the factor of variances at inputs ``... x (m) x q x d``, ``... x (m) x q``.

        Without ``recent`` it is that of left-out observations alone.
        """
        near = Stationary(self.lengthscale, x.new_ones(()), RBF).covariance(x, self.points)
        total = (near @ self.squares.unsqueeze(-1)).squeeze(-1)
        factor = ((_EXPECTED + total) / (_EXPECTED + near.sum(-1))).clamp_min(1.0)
        if recent:
            errors, number = self.recent.unsqueeze(-2).unbind(-1)
            factor = factor * ((_RECENT + errors) / (_RECENT + number)).clamp_min(1.0)
        return factor

    def observe(self, squares: Tensor, forget: float) -> None:
        """Take squared errors of new observations, ``batch_shape x (m) x k``; NaN for none."""
        for each in squares.unbind(-1):
            new = torch.stack([each.nan_to_num(nan=0.0), (~each.isnan()).to(each)], dim=-1)
            self.recent = math.exp(-1 / forget) * self.recent + new

    def learn(self, squares: Tensor, points: Tensor, lengthscale: Tensor) -> None:
        """Take what is said above."""
        self.squares, self.points, self.lengthscale = squares, points, lengthscale
        self.recent = torch.zeros_like(self.recent)

    def forget(self) -> None:
        """Let variances be what kernels say."""
        self.squares, self.points = self.squares[..., :0], self.points[:0]
        self.recent = torch.zeros_like(self.recent)

    def of_outputs(self, numbers: list[int]) -> LocalErrors:
        """Return the factors of some of several outputs."""
        taken = numbers if len(numbers) > 1 else numbers[0]
        squares, lengthscale = self.squares[..., taken, :], self.lengthscale[..., taken, :, :]
        found = LocalErrors(squares.shape[:-1], lengthscale.shape[-1])
        found.learn(squares, self.points, lengthscale)
        found.recent = self.recent[..., taken, :]
        return found

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        """Take errors, however many there are."""
        for name in ("squares", "points"):
            if f"{prefix}{name}" in state_dict:
                setattr(self, name, torch.empty_like(state_dict[f"{prefix}{name}"]))
        super()._load_from_state_dict(state_dict, prefix, *args)
