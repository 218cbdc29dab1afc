"""Dynamics by each of the models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from torch import Tensor

from gpadjust.dynamics.learned_dynamics import LearnedDynamics
from gpadjust.dynamics.state_spec import StateSpec
from gpadjust.dynamics.transition_physics import Target
from gpadjust.inference.fitting import FitOptions
from gpadjust.models import (
    CKA,
    RRA,
    AdjustedGP,
    ExactGPBase,
    PaperRRA,
    PhysicsMeanGP,
    ScaleGP,
    ZeroMeanGP,
)
from gpadjust.models.adjusted_gp import PhysicsLike
from gpadjust.physics import Physics


class GPDynamics(LearnedDynamics):
    """Dynamics of a Gaussian process without physics (:class:`~gpadjust.ZeroMeanGP`).

    The arguments are those of :class:`CKADynamics`, without ``physics``.
    """

    def __init__(
        self,
        spec: StateSpec,
        *,
        target: Target = "difference",
        encode_angles: bool = True,
        model_options: Mapping[str, Any] | None = None,
        fit_options: FitOptions | None = None,
    ) -> None:
        super().__init__(
            spec,
            None,
            target=target,
            encode_angles=encode_angles,
            model_options=model_options,
            fit_options=fit_options,
        )

    def _make_model(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        physics: Physics | None,
        **options: Any,
    ) -> ExactGPBase:
        return ZeroMeanGP(train_X, train_Y, **options)


class CKADynamics(LearnedDynamics):
    r"""A physics of the system, adjusted by co-kriging (:class:`~gpadjust.CKA`).

    Each state's change (or next value) is an independent output
    :math:`f_a = \rho f_p + \delta` of the states that move and the action; integrated states
    follow from their velocities, exogenous ones stay, and previous actions are the action taken.

    Args:
        spec: What the entries of states and actions are.
        physics: The next values of the states that are neither exogenous nor previous actions,
            from these and the actions: columns ``[states, actions]`` in the order of the spec,
            angles in rad. Several: a list, or a dictionary with their names, as of
            :class:`~gpadjust.CKA`.
        target: What the model learns: the ``"difference"`` of next state and state, of an angle
            the shortest way round, or the next state itself (``"absolute"``). A scaling of an
            absolute position or angle depends on where its origin is; one of a change does not.
        encode_angles: Whether the model reads the sine and cosine of angles; the physics always
            reads the angles.
        model_options: Further arguments of the model, such as ``center`` or ``rho_mean``. A
            kernel may be a function of the number of inputs and the batch shape that makes it;
            one that is a module is copied for each fit.
        fit_options: Options of the search that :func:`gpadjust.fit` makes at the first fit.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import CKADynamics, StateSpec
        >>> spec = StateSpec(["x"], ["v"])
        >>> dynamics = CKADynamics(spec, physics=lambda X: X[:, :1] + 0.1 * X[:, 1:])
        >>> x, v = torch.rand(8, 1, dtype=torch.float64), torch.rand(8, 1, dtype=torch.float64)
        >>> dynamics.update(x, v, x + 0.12 * v)
        >>> mean, variance = dynamics.predict(x, v)
        >>> bool((mean - x - 0.12 * v).abs().max() < 1e-3)
        True
    """

    _model_class: ClassVar[type[AdjustedGP]] = CKA

    def __init__(
        self,
        spec: StateSpec,
        physics: PhysicsLike,
        *,
        target: Target = "difference",
        encode_angles: bool = True,
        model_options: Mapping[str, Any] | None = None,
        fit_options: FitOptions | None = None,
    ) -> None:
        super().__init__(
            spec,
            physics,
            target=target,
            encode_angles=encode_angles,
            model_options=model_options,
            fit_options=fit_options,
        )

    def _make_model(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        physics: Physics | None,
        **options: Any,
    ) -> ExactGPBase:
        assert physics is not None, "there is one"
        return self._model_class(train_X, train_Y, physics=physics, **options)


class PhysicsMeanDynamics(CKADynamics):
    """A physics as the mean of a Gaussian process (:class:`~gpadjust.PhysicsMeanGP`).

    The arguments are those of :class:`CKADynamics`.
    """

    _model_class = PhysicsMeanGP


class BiasDynamics(CKADynamics):
    """A physics adjusted by a bias alone (:class:`~gpadjust.BiasGP`).

    The arguments are those of :class:`CKADynamics`.
    """

    _model_class = PhysicsMeanGP


class ScaleDynamics(CKADynamics):
    """A physics adjusted by a scaling alone (:class:`~gpadjust.ScaleGP`).

    The arguments are those of :class:`CKADynamics`. It cannot adjust where the physics is zero,
    which changes of states are somewhere: see the warning of the model at the first fit.
    """

    _model_class = ScaleGP


class RRADynamics(CKADynamics):
    """A physics adjusted by Bayesian linear regression on random features.

    Args:
        spec: As in :class:`CKADynamics`.
        physics: As in :class:`CKADynamics`.
        prior: ``"physics"``, or ``"paper"`` for the closed form as printed in the paper, which
            falls to zero far from the data; see :class:`~gpadjust.models.PaperRRA`.
        num_features: Number of features of each of rho and delta.
        target: As in :class:`CKADynamics`.
        encode_angles: As in :class:`CKADynamics`.
        model_options: As in :class:`CKADynamics`.
        fit_options: As in :class:`CKADynamics`.
    """

    _model_class = RRA

    def __init__(
        self,
        spec: StateSpec,
        physics: PhysicsLike,
        *,
        prior: Literal["physics", "paper"] = "physics",
        num_features: int = 128,
        target: Target = "difference",
        encode_angles: bool = True,
        model_options: Mapping[str, Any] | None = None,
        fit_options: FitOptions | None = None,
    ) -> None:
        if prior not in ("physics", "paper"):
            raise ValueError(f"Unknown prior {prior!r}; expected 'physics' or 'paper'.")
        super().__init__(
            spec,
            physics,
            target=target,
            encode_angles=encode_angles,
            model_options={"num_features": num_features, **(model_options or {})},
            fit_options=fit_options,
        )
        self.prior = prior

    def describe(self) -> dict[str, str]:
        """As the base class, with the prior."""
        return {**super().describe(), "prior": self.prior}

    def _make_model(
        self,
        train_X: Tensor,
        train_Y: Tensor,
        physics: Physics | None,
        **options: Any,
    ) -> ExactGPBase:
        assert physics is not None, "there is one"
        model_class = PaperRRA if self.prior == "paper" else RRA
        return model_class(train_X, train_Y, physics=physics, **options)
