"""The physics as the mean of a Gaussian process."""

from __future__ import annotations

from collections.abc import Callable

from gpytorch.means import Mean
from torch import Tensor

from gpadjust.gp.physics_columns import CalledPhysics
from gpadjust.physics import Physics, as_physics


class PhysicsMean(Mean):
    r"""The mean function :math:`m(x) = f_p(x)`, for any GPyTorch model.

    The physics may be a torch function or module (whose parameters are then trained with the
    model's), an ODE or a black box; each distinct row is evaluated once. It sees the inputs that
    the model passes to its mean: under an input transform, build on the models in
    :mod:`gpadjust.models`, which show the physics the raw inputs.

    Args:
        physics: The physics f_p, ``... x n x d`` to ``... x n x m`` or ``n``.
        output: Which of the physics' outputs to use, if it has several.

    Example:
        >>> import torch
        >>> from gpadjust.gp import PhysicsMean
        >>> mean = PhysicsMean(lambda X: X.sum(-1))
        >>> mean(torch.ones(3, 2, dtype=torch.float64))
        tensor([2., 2., 2.], dtype=torch.float64)
    """

    def __init__(
        self, physics: Physics | Callable[[Tensor], Tensor], output: int | None = None
    ) -> None:
        super().__init__()
        self.physics = CalledPhysics(as_physics(physics), output)

    def forward(self, x: Tensor) -> Tensor:
        """Return f_p at ``x`` (``... x n x d``) as ``... x n``."""
        values: Tensor = self.physics(x)
        return values
