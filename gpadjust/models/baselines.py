"""The Gaussian processes that the adjustments are compared with."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.posteriors import GPyTorchPosterior
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.kernels import Kernel
from gpytorch.likelihoods import Likelihood
from gpytorch.means import ZeroMean
from torch import Tensor

from gpadjust.models.adjustment_gp import AdjustmentGP
from gpadjust.models.defaults import (
    default_likelihood,
    make_kernel,
    scaled_rbf,
)
from gpadjust.models.multi_output_gp import MultiOutputGP
from gpadjust.models.parameter_scales import set_initial_values
from gpadjust.models.target_units import residual_scale
from gpadjust.models.training_data import check_training_data
from gpadjust.physics import Physics


class ZeroMeanGP(MultiOutputGP):
    r"""A Gaussian process without physics, :math:`f \sim GP(0, k)`.

    Args:
        train_X: Inputs, ``batch_shape x n x d``, float64.
        train_Y: Targets, ``batch_shape x n x m``, float64.
        train_Yvar: Known observation variances, or None to learn one per output.
        covar_module: The kernel. Default: RBF with a lengthscale per input.
        likelihood: A Gaussian likelihood. Default: learnt noise, at least 1e-6 of the targets'
            mean square.
        outcome_transform: ``Standardize`` or None. Default: division by the targets' root mean
            square.
        input_transform: A BoTorch input transform.

    Raises:
        TypeError: If data are not float64 tensors.
        ValueError: If shapes disagree, data are not finite, or there are fewer than two points.
    """

    def __init__(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        train_Yvar: Tensor | None = None,
        *,
        covar_module: Kernel | None = None,
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
    ) -> None:
        check_training_data(train_X, train_Y, train_Yvar)
        batch_shape = self.get_batch_dimensions(train_X, train_Y)[1]
        if isinstance(outcome_transform, _DefaultType):
            outcome_transform = residual_scale(train_Y, torch.zeros_like(train_Y))
        d = self.transform_inputs(train_X, input_transform).shape[-1]
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            likelihood=likelihood or default_likelihood(train_Yvar, batch_shape),
            covar_module=make_kernel(covar_module or scaled_rbf, "covar_module", d, batch_shape),
            mean_module=ZeroMean(),
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )
        set_initial_values(self, covar_module, likelihood)


class PhysicsMeanGP(AdjustmentGP):
    r"""A Gaussian process with the physics as its mean, :math:`f \sim GP(f_p, k)`.

    Args:
        train_X: Inputs, ``batch_shape x n x d``, float64.
        train_Y: Targets, ``batch_shape x n x m``, float64.
        train_Yvar: Known observation variances, or None to learn one per output.
        physics: The physics f_p, as in :class:`~gpadjust.CKA`.
        covar_module: The kernel. Default: RBF with a lengthscale per input.
        learn_rho_mean: Scale the physics by an unknown constant, :math:`f \sim GP(\rho f_p, k)`.
        learn_delta_mean: Add an unknown constant to the mean.
        likelihood: As in :class:`~gpadjust.CKA`.
        outcome_transform: As in :class:`~gpadjust.CKA`.
        input_transform: As in :class:`~gpadjust.CKA`.

    Raises:
        TypeError: As :class:`~gpadjust.CKA`.
        ValueError: As :class:`~gpadjust.CKA`.
        PhysicsError: As :class:`~gpadjust.CKA`.
    """

    def __init__(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        train_Yvar: Tensor | None = None,
        *,
        physics: Physics | Callable[[Tensor], Tensor],
        covar_module: Kernel | None = None,
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
            rho_covar_module=None,
            delta_covar_module=covar_module or scaled_rbf,
            learn_rho_mean=learn_rho_mean,
            learn_delta_mean=learn_delta_mean,
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )


class BiasGP(PhysicsMeanGP):
    r"""An adjustment by a bias alone, :math:`f_a = f_p + \delta`, :math:`\delta \sim GP(0, k)`.

    The same prior as :class:`~gpadjust.PhysicsMeanGP`, seen as an adjustment: ``delta(X)`` is the
    posterior of the bias. It takes the same arguments.
    """

    def delta(self, X: Tensor) -> GPyTorchPosterior:
        r"""The posterior of :math:`\delta` at raw ``X`` (``... x q x d``), in y's units."""
        return self._adjustment(X, "delta")


class ScaleGP(AdjustmentGP):
    r"""An adjustment by a scaling alone, :math:`f_a = \rho f_p`, :math:`\rho \sim GP(1, k)`.

    It cannot adjust where f_p is zero, and explodes near there: a warning says so when f_p nearly
    vanishes at a training input.

    Args:
        train_X: Inputs, ``batch_shape x n x d``, float64.
        train_Y: Targets, ``batch_shape x n x m``, float64.
        train_Yvar: Known observation variances, or None to learn one per output.
        physics: The physics f_p, as in :class:`~gpadjust.CKA`.
        covar_module: The kernel of rho. Default: RBF with a lengthscale per input.
        likelihood: As in :class:`~gpadjust.CKA`.
        outcome_transform: As in :class:`~gpadjust.CKA`.
        input_transform: As in :class:`~gpadjust.CKA`.

    Raises:
        TypeError: As :class:`~gpadjust.CKA`.
        ValueError: As :class:`~gpadjust.CKA`, and if f_p is zero at all training inputs.
        PhysicsError: As :class:`~gpadjust.CKA`.
    """

    def __init__(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        train_Yvar: Tensor | None = None,
        *,
        physics: Physics | Callable[[Tensor], Tensor],
        covar_module: Kernel | None = None,
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
    ) -> None:
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            physics=physics,
            rho_covar_module=covar_module or scaled_rbf,
            delta_covar_module=None,
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )
        size = self.physics(train_X).detach().abs()
        typical = size.square().mean(-2, keepdim=True).sqrt()
        if (typical == 0).any():
            raise ValueError(
                f"The physics '{self.physics.name}' is zero at all training inputs (in some "
                "output), so scaling it changes nothing; use BiasGP or CKA."
            )
        small = (size < 1e-2 * typical).any(-1)
        if small.any():
            warnings.warn(
                f"f_p is nearly zero at {int(small.sum())} of {small.numel()} training inputs, "
                "where ScaleGP cannot adjust it and may explode; CKA can.",
                stacklevel=2,
            )

    def rho(self, X: Tensor) -> GPyTorchPosterior:
        r"""The posterior of :math:`\rho` at raw ``X`` (``... x q x d``), without units."""
        return self._adjustment(X, "rho")
