"""Where left-out observations are missed by more than predicted, and what that says of variances."""

from __future__ import annotations

import torch
from torch import Size, Tensor
from torch.nn import Module

from gpadjust.gp.kernels import RBF, Stationary

_EXPECTED = 2.0  # observations that err as predicted, added to those near a point


class LocalErrors(Module):
    r"""How much larger errors are near a point than a Gaussian process of stationary kernels says.

    Where a function has a kink or a jump, as by dry friction or an impact, such a process is too
    sure nearby. With :math:`z_i^2` the squared error of a left-out observation over its predicted
    variance, variances at x are multiplied by

    .. math:: \max\Big(1, \frac{a + \sum_i k(x, x_i) z_i^2}{a + \sum_i k(x, x_i)}\Big),

    with an RBF kernel k of the shortest lengthscale of all terms, input by input. It is a normalised
    form of conformal prediction by local left-out residuals (Lei et al. 2018, sec. 5.2), smoothed.

    Args:
        outputs: The batch shape of a model with its outputs last, ``batch_shape x (m)``.
        num_points: Number ``n`` of observations.
        num_inputs: Number ``d`` of inputs that kernels read.
    """

    squares: Tensor
    points: Tensor
    lengthscale: Tensor

    def __init__(self, outputs: Size, num_points: int, num_inputs: int) -> None:
        super().__init__()
        one = torch.ones((), dtype=torch.float64)
        self.register_buffer("squares", one.expand(*outputs, num_points).clone())
        self.register_buffer("points", one.expand(num_points, num_inputs).clone())
        self.register_buffer("lengthscale", one.expand(*outputs, 1, num_inputs).clone())

    @property
    def are_expected(self) -> bool:
        """Whether no error is larger than predicted, so that no variance is changed."""
        return bool((self.squares <= 1).all())

    def forward(self, x: Tensor) -> Tensor:
        """What variances are multiplied by at inputs ``... x (m) x q x d``, ``... x (m) x q``."""
        near = Stationary(self.lengthscale, x.new_ones(()), RBF).covariance(x, self.points)
        total = (near @ self.squares.unsqueeze(-1)).squeeze(-1)
        return ((_EXPECTED + total) / (_EXPECTED + near.sum(-1))).clamp_min(1.0)

    def learn(self, squares: Tensor, points: Tensor, lengthscale: Tensor) -> None:
        """Take squared errors in predicted variances, where they are, and the lengthscale."""
        for old, new in ((self.squares, squares), (self.points, points)):
            old.copy_(new)
        self.lengthscale.copy_(lengthscale)

    def forget(self) -> None:
        """Take errors as expected."""
        self.squares.fill_(1.0)

    def of_outputs(self, numbers: list[int]) -> LocalErrors:
        """Those of some of several outputs."""
        taken = numbers if len(numbers) > 1 else numbers[0]
        squares, lengthscale = self.squares[..., taken, :], self.lengthscale[..., taken, :, :]
        found = LocalErrors(squares.shape[:-1], squares.shape[-1], lengthscale.shape[-1])
        found.to(squares).learn(squares, self.points, lengthscale)
        return found
