"""Co-kriging adjustment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.posteriors import GPyTorchPosterior
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.kernels import Kernel
from gpytorch.likelihoods import Likelihood
from torch import Tensor

from gpadjust.models.adjustment_gp import AdjustmentGP
from gpadjust.models.defaults import scaled_rbf
from gpadjust.physics import Physics


class CKA(AdjustmentGP):
    r"""Co-kriging adjustment of a physics model (Wannawas and Faisal 2023, section 2.1):

    .. math::
        f_a(x) = \rho(x) f_p(x) + \delta(x), \quad
        \rho \sim GP(1, k_\rho), \quad \delta \sim GP(0, k_\delta),

    so that :math:`f_a \sim GP(f_p, F_p k_\rho F_p^T + k_\delta)`: where there are no data, the
    model falls back to the physics, and knows that it does.

    A ``SingleTaskGP`` like any other: several columns of ``train_Y`` make independent outputs.
    Fit it with :func:`gpadjust.fit` or ``fit_gpytorch_mll``.

    Args:
        train_X: Inputs, ``batch_shape x n x d``, float64, in the units that the physics reads.
        train_Y: Targets, ``batch_shape x n x m``, float64, in the units that the physics returns.
        train_Yvar: Known observation variances of the shape of ``train_Y``, or None to learn one
            noise variance per output.
        physics: The physics f_p: a torch function or module, or a
            :class:`~gpadjust.physics.Physics`; ``n x d`` to ``n x m`` (or ``n``).
        rho_covar_module: The kernel :math:`k_\rho`. Default: RBF with a lengthscale per input.
        delta_covar_module: The kernel :math:`k_\delta`. Default: likewise.
        center: With a constant c, the kernel is built on :math:`f_p - c`, in the user's units
            (``"mean"``: its mean at ``train_X``). The literal model has 0. Take ``"mean"`` where
            f_p varies little about a large constant, which rho and delta would dispute otherwise.
        learn_rho_mean: Take the constant mean of :math:`\rho` as unknown instead of 1, with a vague
            prior, as in universal kriging: for a physics that is wrong by an unknown factor
            throughout. Far from the data the model then falls back to the scaled physics.
        learn_delta_mean: Take the constant mean of :math:`\delta` as unknown instead of 0.
        likelihood: A Gaussian likelihood. Default: learnt noise, at least 1e-6 of the mean square
            of ``train_Y - f_p``.
        outcome_transform: ``Standardize`` or None. Default: division by the root mean square of
            ``train_Y - f_p``. Hyper-parameters are in the units after it.
        input_transform: A one-to-one BoTorch input transform; the physics still sees raw inputs.

    Raises:
        TypeError: If data are not float64 tensors or the physics is not callable.
        ValueError: If shapes disagree, data are not finite, or there are fewer than two points.
        PhysicsError: If the physics fails, or returns NaN or a wrong shape.

    Example:
        >>> import torch
        >>> from gpadjust import CKA, fit
        >>> train_X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> train_Y = 2 * torch.sin(6 * train_X) + train_X
        >>> model = CKA(train_X, train_Y, physics=lambda X: torch.sin(6 * X))
        >>> result = fit(model)
        >>> test_X = torch.tensor([[0.33]], dtype=torch.float64)
        >>> round(model.posterior(test_X).mean.item(), 2)
        2.16
        >>> rho, delta = model.rho(test_X), model.delta(test_X)
    """

    def __init__(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        train_Yvar: Tensor | None = None,
        *,
        physics: Physics | Callable[[Tensor], Tensor],
        rho_covar_module: Kernel | None = None,
        delta_covar_module: Kernel | None = None,
        center: float | Tensor | Literal["mean"] = 0.0,
        learn_rho_mean: bool = False,
        learn_delta_mean: bool = False,
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
    ) -> None:
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            physics=physics,
            rho_covar_module=rho_covar_module or scaled_rbf,
            delta_covar_module=delta_covar_module or scaled_rbf,
            center=center,
            learn_rho_mean=learn_rho_mean,
            learn_delta_mean=learn_delta_mean,
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )

    def rho(self, X: Tensor) -> GPyTorchPosterior:
        r"""The posterior of the scaling :math:`\rho` at ``X``; f_p is not evaluated there.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.

        Returns:
            A posterior over ``batch_shape x q x m``, without units.
        """
        return self._adjustment(X, "rho")

    def delta(self, X: Tensor) -> GPyTorchPosterior:
        r"""The posterior of the bias :math:`\delta` at ``X``; f_p is not evaluated there.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.

        Returns:
            A posterior over ``batch_shape x q x m``, in the units of the targets.
        """
        return self._adjustment(X, "delta")
