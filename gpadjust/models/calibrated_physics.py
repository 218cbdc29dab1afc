"""The physics with its unknown parameters, and nothing else."""

from __future__ import annotations

from typing import Any

from gpadjust.models.adjusted_gp import AdjustedGP, Adjustment, PhysicsLike
from gpadjust.models.training_data import ArrayLike
from gpadjust.physics import as_physics


class CalibratedPhysics(AdjustedGP):
    r"""The physics itself, :math:`y = f_p(x; \theta) + \epsilon`: nonlinear regression.

    Its unknown parameters :math:`\theta` and the variance of the noise are learnt. What the physics
    cannot say, whatever its parameters, is noise to it, so that intervals of the parameters are too
    narrow where it is wrong: compare it with :class:`~gpadjust.PhysicsMeanGP` and
    :class:`~gpadjust.CKA` of the same physics, which add what it lacks.

    Args:
        train_X: As in :class:`~gpadjust.CKA`, like all that follow.
        train_Y: Observations.
        train_Yvar: Their known variances.
        physics: The physics, with unknown parameters.
        options: ``likelihood``, ``outcome_transform``, ``input_transform``.

    Raises:
        ValueError: If the physics has no unknown parameter.

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
        **options: Any,
    ) -> None:
        physics = as_physics(physics)
        if not physics.unknowns:
            raise ValueError(
                f"Physics {physics.name!r} has no unknown parameter, so that there is nothing to "
                "calibrate; say which it has with unknowns={'mass': Unknown(1.0, factor=1.5)}."
            )
        rho, delta = Adjustment(None, 1.0), Adjustment(None, 0.0)
        super().__init__(train_X, train_Y, train_Yvar, physics, rho, delta, center=0.0, **options)
