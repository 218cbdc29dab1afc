"""Co-kriging adjustment and what it is compared with: each a list of terms."""

from __future__ import annotations

import warnings
from typing import Literal, Unpack

import torch

from gpadjust.models.parameters import scaled_rbf
from gpadjust.models.term_builder import (
    Center,
    KernelLike,
    Kernels,
    Means,
    ModelOptions,
    PhysicsLike,
    TermBuilder,
)
from gpadjust.models.terms_gp import TermsGP
from gpadjust.models.training_data import ArrayLike
from gpadjust.physics import as_physics


class CKA(TermsGP):
    r"""Co-kriging adjustment of a physics model (Wannawas and Faisal 2023, section 2.1):

    .. math::
        f_a(x) = \rho(x) f_p(x) + \delta(x), \quad
        \rho \sim GP(1, k_\rho), \quad \delta \sim GP(0, k_\delta),

    so that :math:`f_a \sim GP(f_p, F_p k_\rho F_p^T + k_\delta)`: where there are no data, the
    model falls back to the physics, and knows that it does. Of several physics it is :math:`f_a(x)
    = \sum_i \rho_i(x) f_i(x) + \delta(x)`, and falls back to their sum with weights, the prior
    means of the :math:`\rho_i`.

    A ``SingleTaskGP`` like any other: several columns of ``train_Y`` make independent outputs.
    Fit it with :func:`gpadjust.fit` or ``fit_gpytorch_mll``.

    Args:
        train_X: Inputs, ``batch_shape x n x d``, float64, in the units that the physics reads. A
            NumPy array or DataFrame will do; the names of its columns are shown in plots.
        train_Y: Targets, ``batch_shape x n x m``, in the units that the physics returns; NaN where
            an output was not observed.
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
            ``"learn"`` for an unknown constant with a vague prior, as in universal kriging, which
            scales a physics that is wrong by a factor. Default: 1, of several ``"learn"``.
        delta_mean: The prior mean of :math:`\delta`, a number or ``"learn"``.
        center: The kernel is built on :math:`f_p - c`. By default, ``"learn"``, the constant c is a
            hyper-parameter, so that a constant in both f_p and targets makes no difference; a point
            fit (``"map"``) leaves it at the mean of f_p at ``train_X``, where ``"mean"`` keeps it.
            A number is c in the user's units; the literal model has 0.
        likelihood: A Gaussian likelihood, a function of the :class:`~gpadjust.models.TermBuilder`
            that makes one, or names: ``"relative"``, noise of a constant standard deviation and one
            that is a share of f_p (without physics, of the posterior mean), both learnt;
            ``"heavy-tailed"``, of which some observations may be outliers (:meth:`outliers`); a
            sequence of both. Default: learnt noise, with a standard deviation of at least three
            millionths of the root mean square of ``train_Y - f_p``.
        outcome_transform: ``Standardize`` or None. Default: division by the root mean square of
            ``train_Y - f_p``. Hyper-parameters are in the units after it. Or a link of bounded
            outputs, through which f_p goes, too: ``"log"`` (BoTorch's ``Log()``) of positive ones,
            ``"logit"`` of shares, or bounds ``(lower, upper)``, see
            :class:`~gpadjust.models.Logit`; rho, delta and noise are then of its values.
        input_transform: A one-to-one BoTorch input transform; the physics still sees raw inputs.
        train_Xvar: Known variances of errors of measured inputs: of the shape of ``train_X``, one
            for each input, or one number; 0 where they are exact. Predictions are at exact inputs.
        categorical: Names or numbers of the columns that are categories, or a mapping from these to
            their levels. Text in a DataFrame is one without being named; f_p gets the numbers of
            its levels, sorted, from 0.
        batch: Names or numbers of columns of which each level has an offset of its own, a term of
            the column's name; other levels are new ones.

    Warns:
        PhysicsWarning: If f_p is obviously off at the training inputs, and shows why.
        UserWarning: Of rows that equal an earlier one, outputs included;
            of more than 5,000 points; take :class:`~gpadjust.VariationalCKA`.

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
        rho_covar_module: Kernels = None,
        delta_covar_module: KernelLike | None = None,
        rho_mean: Means | None = None,
        delta_mean: float | Literal["learn"] = 0.0,
        center: Center = "learn",
        **options: Unpack[ModelOptions],
    ) -> None:
        make = TermBuilder.of_adjustment(
            train_X, train_Y, train_Yvar, physics, rho_mean=rho_mean, center=center, **options
        )
        rhos = make.rhos(rho_covar_module or scaled_rbf)
        super().__init__(make, [*rhos, make.delta(delta_covar_module or scaled_rbf, delta_mean)])


class ZeroMeanGP(TermsGP):
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
        **options: Unpack[ModelOptions],
    ) -> None:
        make = TermBuilder.of_adjustment(
            train_X, train_Y, train_Yvar, None, rho_mean=None, center=0.0, **options
        )
        super().__init__(make, [make.delta(covar_module or scaled_rbf, name="f")])


class PhysicsMeanGP(TermsGP):
    r"""A Gaussian process with the physics as its mean, :math:`f \sim GP(f_p, k)`.

    Seen as an adjustment, the paper's GP-bias (:data:`~gpadjust.models.BiasGP`), it is a bias
    alone, :math:`f_a = f_p + \delta`, :math:`\delta \sim GP(0, k)`, with the posterior
    ``delta(X)``.

    The arguments and errors are those of :class:`~gpadjust.CKA`, but for:

    Args:
        covar_module: The kernel k. Default: RBF with a lengthscale per input.
        rho_mean: ``"learn"`` scales the physics by an unknown constant, :math:`\rho f_p`.
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
        **options: Unpack[ModelOptions],
    ) -> None:
        make = TermBuilder.of_adjustment(
            train_X, train_Y, train_Yvar, physics, rho_mean=rho_mean, center=0.0, **options
        )
        delta = make.delta(covar_module or scaled_rbf, delta_mean)
        super().__init__(make, [*make.rhos(None), delta])


BiasGP = PhysicsMeanGP
"""The paper's name of the same model, :math:`f_a = f_p + \\delta`, seen as an adjustment."""


class ScaleGP(TermsGP):
    r"""An adjustment by a scaling alone, :math:`f_a = \rho f_p`, :math:`\rho \sim GP(1, k)`.

    It cannot adjust where f_p is zero, and explodes near there; a warning counts such data.

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
        **options: Unpack[ModelOptions],
    ) -> None:
        make = TermBuilder.of_adjustment(
            train_X, train_Y, train_Yvar, physics, rho_mean=rho_mean, center=0.0, **options
        )
        super().__init__(make, [*make.rhos(covar_module or scaled_rbf), make.delta(None)])
        size = torch.stack(make.f).abs().sum(0)
        typical = size.square().mean(-2, keepdim=True).sqrt()
        if not typical.all():
            raise ValueError(
                f"The physics '{self.physics.name}' is zero at all training inputs (in some "
                "output), so scaling it changes nothing; use BiasGP or CKA."
            )
        if (small := (size < 1e-2 * typical).any(-1)).any():
            warnings.warn(
                f"f_p is nearly zero at {int(small.sum())} of {small.numel()} training inputs, "
                "where ScaleGP cannot adjust it and may explode; CKA can.",
                stacklevel=2,
            )


class CalibratedPhysics(TermsGP):
    r"""The physics itself, :math:`y = f_p(x; \theta) + \epsilon`: nonlinear regression.

    Its unknown parameters :math:`\theta` and the variance of the noise are learnt. Where the
    physics is wrong, intervals of the parameters are too narrow: compare it with
    :class:`~gpadjust.PhysicsMeanGP` and :class:`~gpadjust.CKA` of the same physics.

    The arguments and errors are those of :class:`~gpadjust.CKA`, without those about rho and delta.

    Raises:
        ValueError: Also if the physics has no unknown parameter.

    Example:
        >>> import torch
        >>> from gpadjust import CalibratedPhysics, fit
        >>> from gpadjust.physics import FunctionPhysics, Unknown
        >>> law = FunctionPhysics(
        ...     lambda t, p: 0.5 * p.g * t[:, 0] ** 2, unknowns={"g": Unknown(9.0, sd=1.0)}
        ... )
        >>> t = torch.linspace(0.1, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CalibratedPhysics(t, 0.5 * 9.81 * t**2, physics=law)
        >>> result = fit(model)
        >>> round(model.physics_parameters.mean.item(), 3)
        9.81
    """

    def __init__(
        self,
        train_X: ArrayLike,
        train_Y: ArrayLike,
        train_Yvar: ArrayLike = None,
        *,
        physics: PhysicsLike,
        **options: Unpack[ModelOptions],
    ) -> None:
        physics = as_physics(physics)
        if not physics.unknowns:
            raise ValueError(
                f"Physics {physics.name!r} has no unknown parameter, so that there is nothing to "
                "calibrate; say which it has with unknowns={'mass': Unknown(1.0, factor=1.5)}."
            )
        make = TermBuilder.of_adjustment(
            train_X, train_Y, train_Yvar, physics, rho_mean=1.0, center=0.0, **options
        )
        super().__init__(make, [*make.rhos(None), make.delta(None)])
