"""Co-kriging adjustment."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal

from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import Standardize
from botorch.utils.types import DEFAULT, _DefaultType
from gpytorch.likelihoods import Likelihood
from torch import Tensor

from gpadjust.models.adjusted_gp import (
    AdjustedGP,
    Adjustment,
    KernelLike,
    Means,
    PhysicsLike,
)
from gpadjust.models.hyperparameters import scaled_rbf
from gpadjust.models.training_data import ArrayLike

_MANY = 5000  # points, of which exact models are slow


class CKA(AdjustedGP):
    r"""Co-kriging adjustment of a physics model (Wannawas and Faisal 2023, section 2.1):

    .. math::
        f_a(x) = \rho(x) f_p(x) + \delta(x), \quad
        \rho \sim GP(1, k_\rho), \quad \delta \sim GP(0, k_\delta),

    so that :math:`f_a \sim GP(f_p, F_p k_\rho F_p^T + k_\delta)`: where there are no data, the
    model falls back to the physics, and knows that it does.

    Of several physics it is a sum with a function for each,
    :math:`f_a(x) = \sum_i \rho_i(x) f_i(x) + \delta(x)`. The prior mean of each
    :math:`\rho_i` is a weight, unknown unless it is given: far from the data the model falls back
    to the weighted sum of the physics, with the weights that the data suggest.

    A ``SingleTaskGP`` like any other: several columns of ``train_Y`` make independent outputs.
    Fit it with :func:`gpadjust.fit` or ``fit_gpytorch_mll``.

    Args:
        train_X: Inputs, ``batch_shape x n x d``, float64, in the units that the physics reads. A
            NumPy array or DataFrame will do; the names of its columns are shown in plots.
        train_Y: Targets, ``batch_shape x n x m``, in the units that the physics returns; NaN where
            an output was not observed, which :func:`gpadjust.fit` understands (and
            ``fit_gpytorch_mll`` does not).
        train_Yvar: Known observation variances: of the shape of ``train_Y``, one for each output,
            or one number. None to learn one noise variance per output.
        physics: The physics f_p: a torch function or module, or a
            :class:`~gpadjust.physics.Physics`; ``n x d`` to ``n x m`` (or ``n``). Several: a list,
            or a dictionary with their names.
        rho_covar_module: The kernel :math:`k_\rho`, or a function of the number of inputs and the
            batch shape that makes it (of several physics, a sequence of kernels or such a
            function). Default: RBF with a lengthscale per input.
        delta_covar_module: The kernel :math:`k_\delta`. Default: likewise.
        rho_mean: The prior mean of :math:`\rho`: a number (of several physics, one each), or
            ``"learn"`` for a constant that is unknown, with a vague prior, as in universal
            kriging: for a physics that is wrong by an unknown factor throughout. Far from the data
            the model then falls back to the scaled physics. Default: 1, of several ``"learn"``.
        delta_mean: The prior mean of :math:`\delta`, a number or ``"learn"``.
        center: The kernel is built on :math:`f_p - c`. By default, ``"learn"``, the constant c is a
            hyper-parameter, so that a constant in both f_p and targets makes no difference, however
            large; a point fit (``"map"``) leaves it at the mean of f_p at ``train_X``, where
            ``"mean"`` keeps it. A number is c in the user's units; the literal model has 0.
        likelihood: A Gaussian likelihood. Default: learnt noise, with a standard deviation of at
            least three millionths of the root mean square of ``train_Y - f_p``.
        outcome_transform: ``Standardize`` or None. Default: division by the root mean square of
            ``train_Y - f_p``. Hyper-parameters are in the units after it.
        input_transform: A one-to-one BoTorch input transform; the physics still sees raw inputs.

    Warns:
        UserWarning: Of more than 5,000 points, for which there is
            :class:`~gpadjust.VariationalCKA`.

    Raises:
        TypeError: If data are no float64 tensors, arrays or frames, or the physics is not callable.
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
        >>> round(model.predict(test_X).mean.item(), 2)
        2.16
        >>> rho, delta = model.rho(test_X), model.delta(test_X)
    """

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike,
        rho_covar_module: KernelLike | Sequence[KernelLike] | None = None,
        delta_covar_module: KernelLike | None = None,
        rho_mean: Means | None = None,
        delta_mean: float | Literal["learn"] = 0.0,
        center: float | Tensor | Literal["mean", "learn"] = "learn",
        likelihood: Likelihood | None = None,
        outcome_transform: Standardize | _DefaultType | None = DEFAULT,
        input_transform: InputTransform | None = None,
    ) -> None:
        n = getattr(train_X, "shape", (0, 0))[-2]
        if type(self) is CKA and n > _MANY:
            warnings.warn(
                f"CKA is exact: of {n} points a fit takes from many minutes to hours, and each "
                f"covariance {8e-9 * n**2:.1f} GB. "
                "gpadjust.VariationalCKA takes the same arguments and learns from all of them in "
                "minutes.",
                UserWarning,
                stacklevel=2,
            )
        super().__init__(
            train_X,
            train_Y,
            train_Yvar,
            physics,
            rho=Adjustment(rho_covar_module or scaled_rbf, rho_mean),
            delta=Adjustment(delta_covar_module or scaled_rbf, delta_mean),
            center=center,
            likelihood=likelihood,
            outcome_transform=outcome_transform,
            input_transform=input_transform,
        )
