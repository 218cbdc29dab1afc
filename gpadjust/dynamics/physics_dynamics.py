"""Dynamics by a physics alone, with or without unknown parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.core import Prediction
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.least_squares import even_normal, most_likely
from gpadjust.dynamics.state import PhysicsProbes, check_numbers, columns_of, fingerprint, loading
from gpadjust.dynamics.targets import checked_physics_error, next_values, one_physics
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import Physics
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.states import StateSpec

_DRAWS = 1024


class PhysicsDynamics(Dynamics):
    r"""The physics alone, with the most likely values of its unknown parameters.

    With the true system as physics it is the oracle that bounds any model.

    Each `update` fits unknown parameters to all transitions so far, by least squares of one step:
    they minimise

    .. math:: \sum_i \tfrac{n_i}{2} \log \sum_j r_{ij}^2 + \tfrac12 |z|^2

    with the errors :math:`r_{ij}` of the :math:`n_i` measured next values of state i, so that each
    state counts in units of its own error, and the coordinates z of the parameters, which are
    standard normal by their prior (:class:`~gpadjust.physics.Unknown`). The search begins at the
    best of the guesses and 512 draws from the prior. A parameter that the transitions do not
    determine stays in the middle of its prior, with a warning. The remaining errors are the noise
    of measured next states; functions have no noise.

    Args:
        spec: Names and kinds of the entries of states and actions.
        physics: One physics, as of :class:`LearnedDynamics`.
        physics_error: Standard deviations of the error of a step of the physics, by the name of the
            state, for predictions before the first fit. Default: none.

    Raises:
        TypeError: If ``spec`` is not a :class:`StateSpec`, or the physics is not callable.
        ValueError: If there are several physics, one returns the change of the state, or
            ``physics_error`` names a state that does not move, or is negative.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> from gpadjust.physics import FunctionPhysics, Unknown
        >>> def coast(X, p):
        ...     return X[:, :1] * (1 - p.drag).unsqueeze(-1) + 0.1 * X[:, 1:]
        >>> physics = FunctionPhysics(coast, unknowns={"drag": Unknown(0.2, factor=2.0)})
        >>> dynamics = PhysicsDynamics(StateSpec(["v"], ["force"]), physics)
        >>> v, force = torch.rand(2, 20, 1, dtype=torch.float64)
        >>> dynamics.update(v, force, 0.7 * v + 0.1 * force)
        >>> dynamics.physics_parameters.mean
        tensor([0.3000], dtype=torch.float64)
    """

    is_fitted = True  # before transitions, by the guesses

    def __init__(
        self,
        spec: StateSpec,
        physics: Physics | Callable[[Tensor], Tensor],
        *,
        physics_error: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(spec)
        self.physics_error = checked_physics_error(spec, physics_error)
        self.physics = one_physics(physics, spec, "LearnedDynamics takes several")
        self._probes: PhysicsProbes | None = None  # of the first transitions
        self._fitted: _Fitted | None = None

    @property
    def has_learnt(self) -> bool:
        """True after a fit of the unknown parameters, or if there are none."""
        return self._fitted is not None or not self.physics.unknowns

    @property
    def physics_parameters(self) -> PhysicsParameters:
        """Unknown parameters: 1024 draws around the fit, or the guesses before a fit.

        The draws of the coordinates z are normal, with the precision of the prior and of the slopes
        of the physics at the optimum; their ``sd`` are the standard errors.
        """
        unknowns = self.physics.unknowns
        if self._fitted is None:
            return PhysicsParameters(unknowns, [*unknowns.guess.unsqueeze(-1)])
        point, precision = self._fitted.point, self._fitted.precision
        # z ~ N(point, (precision + I)^-1) = point + L^-T N(0, I)
        chol = torch.linalg.cholesky(precision + torch.eye(len(point)).to(precision))
        normal = even_normal(_DRAWS, len(point), seed=0)
        deviation = torch.linalg.solve_triangular(chol.mT, normal.mT, upper=True).mT
        return PhysicsParameters(unknowns, unknowns.to_values(point + deviation).unbind(-1))

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Fit unknown parameters to these and all earlier transitions, one row or more.

        Errors are those of :meth:`LearnedDynamics.update`.

        Warns:
            PhysicsWarning: If the transitions barely constrain a parameter, or contradict its
                prior.
        """
        data = self._checked(states, actions, next_states)
        probes = self._probes or PhysicsProbes.from_data(self.physics, self.spec, data)
        if self.physics.unknowns:
            if self._fitted is not None:
                data = self._fitted.data.append(data)
            self._fitted = _Fitted(data, *most_likely(self.physics, self.spec, data))
            self.physics.forget()  # outputs at hundreds of parameters are of no further use
        self._probes = probes

    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """Return next states and the variance of noise, before a fit by ``physics_error``."""
        with torch.no_grad():
            following = self._step(states, actions, self._values)
        if self._fitted is not None:
            return Prediction(following, self._fitted.noise.expand_as(following))
        variances = [self.physics_error.get(name, 0.0) ** 2 for name in self.spec.states]
        return Prediction(following, states.new_tensor(variances).expand_as(following))

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return mean squares of the errors of the fitted parameters; zero before a fit."""
        if self._fitted is None:
            return torch.zeros_like(states)
        return self._fitted.noise.expand_as(states)

    def physics_alone(self) -> Dynamics:
        """Return these dynamics."""
        return self

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """Draw next states, with the noise or the ``physics_error``."""
        if self._fitted is None and not self.physics_error:
            return self.predict(states, actions).mean  # no draw from the generator
        return super().sample(states, actions)

    def mean_function(self) -> TransitionFunctions:
        """Return the physics, with its gradients if it has some."""
        return partial(self._step, parameters=self._values)

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Return the physics, for any number of functions, in the form of other dynamics."""
        checked_whole("num_functions", num_functions, 1)
        values = self._values

        def step(states: Tensor, actions: Tensor) -> Tensor:
            self._check_blocks(states, actions, num_functions)
            return self._step(states, actions, values)

        return step

    def describe(self) -> dict[str, str]:
        """Return the settings, each as a text."""
        unknowns = {name: repr(u) for name, u in self.physics.unknowns.items()}
        options = {"unknowns": unknowns, "physics_error": self.physics_error}
        return fingerprint(type(self), self.spec, **{k: v for k, v in options.items() if v})

    def state_dict(self) -> dict[str, Any]:
        """Return settings, fitted values, and the physics' outputs at some transitions."""
        probes = self._probes and [*self._probes]
        fitted = self._fitted and self._fitted._asdict()
        if fitted is not None:
            fitted["transitions"] = columns_of(fitted.pop("data"))
        return deepcopy({"fingerprint": self.describe(), "probes": probes, "fitted": fitted})

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a result of :meth:`state_dict`; errors as of :class:`LearnedDynamics`.

        The physics is compared at no more than three transitions of the state.
        """
        if state == {}:  # before the first update
            state = {"fingerprint": self.describe(), "probes": None, "fitted": None}
        with loading(state, self.describe()) as copy:
            probes, fitted = copy["probes"], copy["fitted"]
            if fitted is not None:
                data = Trajectories.checked(self.spec, **fitted.pop("transitions"))
                fitted = _Fitted(data, **fitted)
                # One number for each parameter, NaN if any entry is.
                values = self.physics.unknowns.to_values(fitted.precision @ fitted.point)
                check_numbers({"fitted": values, "noise": fitted.noise.view(self.spec.state_dim)})
            if probes is not None:
                probes = PhysicsProbes(*probes)
                probes.check(self.physics, self.spec)
        self._probes, self._fitted = probes, fitted

    @property
    def _values(self) -> Tensor | None:
        """The fitted parameters; None for the guesses."""
        return None if self._fitted is None else self.physics.unknowns.to_values(self._fitted.point)

    def _step(self, states: Tensor, actions: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return the next states by the physics."""
        self._check_blocks(states, actions)
        return next_values(self.physics, self.spec, states, actions, parameters)


class _Fitted(NamedTuple):
    """Parameters, and the transitions of their fit."""

    data: Trajectories
    point: Tensor  # coordinates, p
    precision: Tensor  # of the coordinates by the transitions, p x p, without the prior
    noise: Tensor  # mean squares of the errors, state_dim, 0 for states that do not move
