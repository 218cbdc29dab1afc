"""The Gaussian processes that the adjustments are compared with."""

from __future__ import annotations

import warnings
from typing import Literal

from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.likelihoods import Likelihood

from gpadjust.models.adjusted_gp import AdjustedGP, Adjustment, KernelLike, Means, PhysicsLike
from gpadjust.models.hyperparameters import scaled_rbf
from gpadjust.models.training_data import ArrayLike, to_tensor


class ZeroMeanGP(AdjustedGP):
    r"""A Gaussian process without physics, :math:`f \sim GP(0, k)`.

    The arguments and errors are those of :class:`~gpadjust.CKA` with :math:`f_p = 0`, without
    those about physics, rho and delta, and:

    Args:
        covar_module: The kernel. Default: RBF with a lengthscale per input.
    """

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        covar_module: KernelLike | None = None,
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
    ) -> None:
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            physics=None,
            rho=None,
            delta=Adjustment(covar_module or scaled_rbf, 0.0),
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )


class PhysicsMeanGP(AdjustedGP):
    r"""A Gaussian process with the physics as its mean, :math:`f \sim GP(f_p, k)`.

    Seen as an adjustment it is a bias alone, :math:`f_a = f_p + \delta`,
    :math:`\delta \sim GP(0, k)`, and ``delta(X)`` the posterior of the bias: the paper's GP-bias,
    :data:`~gpadjust.BiasGP`, is this model.

    The arguments and errors are those of :class:`~gpadjust.CKA`, but for:

    Args:
        covar_module: The kernel k. Default: RBF with a lengthscale per input.
        rho_mean: A constant; ``"learn"`` scales the physics by an unknown one,
            :math:`f \sim GP(\rho f_p, k)`.
    """

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike,
        covar_module: KernelLike | None = None,
        rho_mean: Means | None = None,
        delta_mean: float | Literal["learn"] = 0.0,
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
    ) -> None:
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            physics,
            rho=Adjustment(None, rho_mean),
            delta=Adjustment(covar_module or scaled_rbf, delta_mean),
            center=0.0,
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )


BiasGP = PhysicsMeanGP
"""The paper's name of the same model, :math:`f_a = f_p + \\delta`, seen as an adjustment."""


class ScaleGP(AdjustedGP):
    r"""An adjustment by a scaling alone, :math:`f_a = \rho f_p`, :math:`\rho \sim GP(1, k)`.

    It cannot adjust where f_p is zero, and explodes near there: a warning says so when f_p nearly
    vanishes at a training input.

    The arguments and errors are those of :class:`~gpadjust.CKA`, but for:

    Args:
        covar_module: The kernel of rho. Default: RBF with a lengthscale per input.

    Raises:
        ValueError: Also if f_p is zero at all training inputs.
    """

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike,
        covar_module: KernelLike | None = None,
        rho_mean: Means | None = None,
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
    ) -> None:
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            physics,
            rho=Adjustment(covar_module or scaled_rbf, rho_mean),
            delta=Adjustment(None, 0.0),
            center=0.0,
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )
        size = self.physics(to_tensor(train_X, "train_X")).detach().abs()
        size = size.unflatten(-1, (-1, self.num_outputs)).sum(-2)  # over several physics
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
