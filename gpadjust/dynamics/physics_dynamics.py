"""Dynamics that are a physics alone, known or with unknown parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import checked_tensor, checked_whole
from gpadjust.core import Prediction
from gpadjust.dynamics.base import Dynamics, TransitionFunctions
from gpadjust.dynamics.least_squares import even_normal, most_likely
from gpadjust.dynamics.state import (
    PhysicsProbes,
    check_fingerprint,
    copies,
    expect,
    fingerprint,
    loaded,
    saved,
)
from gpadjust.dynamics.targets import (
    check_next_values,
    checked_physics_error,
    one_physics,
    warn_of_differences,
)
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import Physics
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.states import StateSpec

_DRAWS = 1024
_BEYOND = 2.0  # times as much again, half a range of the actions beyond it
_MOST = 0.5  # standard deviations of a parameter's prior
_END = 8.0  # coordinate, beyond which there is nothing of a prior


class PhysicsDynamics(Dynamics):
    r"""The physics alone; of its unknown parameters, if it has any, the most likely ones.

    With the true system as physics it is the oracle that bounds what any model can do.

    Unknown parameters are fitted at each `update`, to all transitions so far, by least squares of
    one step: they minimise

    .. math:: \sum_i \tfrac{n_i}{2} \log \sum_j r_{ij}^2 + \tfrac12 |z|^2

    with the errors :math:`r_{ij}` of the :math:`n_i` measured next values of state i, so that each
    state counts in units of its own error, and the coordinates z of the parameters, which are
    standard normal by their prior (:class:`~gpadjust.physics.Unknown`). The search begins at the
    best of the guesses and 512 draws from the prior, and is the same for the same transitions. A
    parameter of which they tell nothing stays in the middle of its prior, with a warning. The
    errors that are left are taken as the noise of measured next states; the functions have none.

    Args:
        spec: What the entries of states and actions are.
        physics: The next values of the states that are neither exogenous nor previous values,
            from the columns that the spec says (``physics_reads``): by default these states and
            the actions.
        physics_error: Standard deviations of the error of a step of the physics, by the name of the
            state; its variance until unknown parameters are fitted. Default: none.

    Raises:
        TypeError: If ``spec`` is no :class:`StateSpec`, or the physics is not callable.
        ValueError: If there are several physics, one returns the change of the state, or
            ``physics_error`` is of no state that moves, or negative.

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

    def __init__(
        self,
        spec: StateSpec,
        physics: Physics | Callable[[Tensor], Tensor],
        *,
        physics_error: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(spec)
        self.physics_error = checked_physics_error(spec, physics_error)
        self.physics = one_physics(physics, spec, "LearnedDynamics learns the weights of several")
        self._probes: PhysicsProbes | None = None
        self._compared = False  # with transitions
        self._fitted: _Fitted | None = None

    @property
    def is_fitted(self) -> bool:
        """True, as the guesses serve before there are transitions."""
        return True

    @property
    def has_learnt(self) -> bool:
        """True once unknown parameters are fitted, or if there are none."""
        return self._fitted is not None or not self.physics.unknowns

    @property
    def physics_parameters(self) -> PhysicsParameters:
        """Unknown parameters: 1024 draws about the fitted ones, or the guesses before.

        The draws are of the normal distribution (of the coordinates z) whose precision the slopes
        of the physics at the optimum say; their ``sd`` are the standard errors, with the prior.
        """
        unknowns = self.physics.unknowns
        if self._fitted is None:
            return PhysicsParameters(unknowns, [*unknowns.guess.unsqueeze(-1)])
        point, precision = self._fitted.point, self._fitted.precision
        spread = even_normal(_DRAWS, len(point), seed=0)
        chol = torch.linalg.cholesky(precision + torch.eye(len(point)).to(precision))
        away = torch.linalg.solve_triangular(chol.mT, spread.mT, upper=True).mT
        return PhysicsParameters(unknowns, unknowns.at(point + away).unbind(-1))

    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Fit unknown parameters to these and all earlier transitions.

        The first transitions show whether the physics returns next states.

        Raises:
            TypeError: As :meth:`LearnedDynamics.update`.
            ValueError: As :meth:`LearnedDynamics.update`, but a single row will do.
            PhysicsError: If the physics fails at the guesses.

        Warns:
            PhysicsWarning: If the transitions say next to nothing of a parameter, or contradict
                its prior.
        """
        data = self._checked(states, actions, next_states)
        if not self._compared:
            columns = self.spec.moving
            change = self._change(data.states, data.actions)
            warn_of_differences(self.physics.name, self.spec, data, columns, change)
            if self._probes is None:
                self._probes = PhysicsProbes.of(data.states, data.actions, change, columns)
        if self.physics.unknowns:
            data = data if self._fitted is None else self._fitted.data.append(data)
            self._fitted = _Fitted(data, *most_likely(self.physics, self.spec, data))
            self.physics.forget()
        self._compared = True

    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """The next states, and the variance of the noise; before a fit, of the stated error."""
        with torch.no_grad():
            following = self._step(states, actions, self._values)
        stated = [self.physics_error.get(name, 0.0) ** 2 for name in self.spec.states]
        error = states.new_tensor(stated) if self._fitted is None else self._fitted.noise
        return Prediction(following, error.expand_as(following))

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """Mean squares of the errors that the fitted parameters leave; else zero."""
        if self._fitted is None:
            return torch.zeros_like(states)
        return self._fitted.noise.expand_as(states)

    def physics_alone(self) -> Dynamics:
        """These dynamics."""
        return self

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """The next states, with the noise or the stated error if there is any."""
        noisy = self._fitted is not None or self.physics_error
        return super().sample(states, actions) if noisy else self.predict(states, actions)[0]

    def mean_function(self) -> TransitionFunctions:
        """The physics, with gradients as far as it has them."""
        return partial(self._step, parameters=self._values)

    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """The physics, whatever the number; the functions are those of :class:`LearnedDynamics`.

        Raises:
            ValueError: If ``num_functions`` is no positive whole number.
        """
        checked_whole("num_functions", num_functions, 1)
        values = self._values

        def step(states: Tensor, actions: Tensor) -> Tensor:
            self._check_blocks(states, actions, num_functions)
            return self._step(states, actions, values)

        return step

    def describe(self) -> dict[str, str]:
        """Return the settings, each as a text."""
        unknowns = {name: repr(u) for name, u in self.physics.unknowns.items()}
        more = {"unknowns": unknowns, "physics_error": self.physics_error}
        return fingerprint(type(self), self.spec, **{k: v for k, v in more.items() if v})

    def state_dict(self) -> dict[str, Any]:
        """Return settings, fitted values, and the physics' outputs at some transitions.

        That is at the guesses of unknown parameters.
        """
        probes = None if self._probes is None else [tensor.clone() for tensor in self._probes]
        fitted = None if self._fitted is None else self._fitted.state_dict()
        return {"fingerprint": self.describe(), "probes": probes, "fitted": fitted}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take back what :meth:`state_dict` gave; predictions and later fits are the same.

        The physics is asked about at most three transitions that the state holds.

        Raises:
            TypeError: If it is no dictionary.
            RuntimeError: If it is of dynamics of another class, spec or physics, or damaged.
            PhysicsError: If the physics fails.
        """
        check_fingerprint(state, self.describe())
        given, moving = state.get("probes"), self.spec.moving
        fitted = _Fitted.checked(state.get("fitted"), self.spec, len(self.physics.unknowns))
        if given is not None:
            probes = PhysicsProbes.checked(given, self.spec, len(moving))
            found = self._change(probes.states, probes.actions)
            probes.check(found, self.physics.name, self.spec, moving)
            self._probes = probes
        self._fitted = fitted
        self.physics.forget()

    @property
    def _values(self) -> Tensor | None:
        """The parameters that it follows, None for the guesses or without any."""
        return None if self._fitted is None else self.physics.unknowns.at(self._fitted.point)

    def _change(self, states: Tensor, actions: Tensor) -> Tensor:
        """The change of the states that move, at the guesses."""
        with torch.no_grad():
            following = self._step(states, actions)
        return self.spec.change(states, following)[..., self.spec.moving]

    def _step(self, states: Tensor, actions: Tensor, parameters: Tensor | None = None) -> Tensor:
        moving = self.spec.moving
        self._check_pair(states, actions)
        following = states.clone()
        inputs = self.spec.physics_inputs(states, actions)
        Y = self.physics(inputs if inputs.dim() > 1 else inputs.unsqueeze(0), parameters)
        check_next_values(self.physics, Y, len(moving))
        following[..., moving] = Y
        return self.spec.remember(following, states, actions)


class _Fitted(NamedTuple):
    """Parameters, and the transitions that they were fitted to."""

    data: Trajectories
    point: Tensor  # coordinates, p
    precision: Tensor  # what the transitions say of these, p x p, without the prior
    noise: Tensor  # mean squares of the errors, state_dim, 0 of states that do not move

    def state_dict(self) -> dict[str, Any]:
        """All of it, in tensors; of the transitions their columns."""
        tensors = {name: getattr(self, name).clone() for name in self._fields[1:]}
        return {"transitions": saved(self.data), **tensors}

    @classmethod
    def checked(cls, state: Any, spec: StateSpec, p: int) -> _Fitted | None:
        """Take a state; a RuntimeError if it is damaged."""
        if state is None:
            return None
        names = ("transitions", *cls._fields[1:])
        whole = isinstance(state, dict) and {*names} <= {*state}
        expect(whole, "fitted", f"a dictionary of {', '.join(names)}")
        data, tensors = loaded(state["transitions"], spec), [state[name] for name in names[1:]]
        return cls(data, *copies(tensors, "fitted", (p,), (p, p), (spec.state_dim,)))


def varying_parameters(
    physics: Physics,
    spec: StateSpec,
    learnt: PhysicsParameters,
    actions: Tensor,
    variation: Tensor | float,
) -> Callable[[int, int | None], Callable[[Tensor, Tensor], Tensor]]:
    """Changes of next states by parameters that differ, in each draw by numbers of its own.

    They vary by standard deviations of their coordinates about those that were learnt, by more
    beyond the actions that were learnt from, ``N x action_dim``.

    Returns:
        A function of a number ``k`` of draws and a seed to a function of states and actions, which
        returns by how much next states ``k x N x state_dim`` are others than by what was learnt,
        NaN where the physics fails.

    Raises:
        TypeError: If ``variation`` is no number or numbers.
        ValueError: If it is not one of 0 or more, or one for each parameter.
    """
    unknowns, moving, p = physics.unknowns, spec.moving, len(physics.unknowns)
    sd = checked_tensor("variation", variation)
    if sd.shape not in ((), (p,)) or not (sd.isfinite() & (sd >= 0)).all():
        raise ValueError(
            f"Expected variation as one number of 0 or more, or one for each of "
            f"{', '.join(unknowns)}, got {sd.tolist()}."
        )
    sd = sd.expand(p)
    center = unknowns.coordinates(learnt.draws).clamp(-_END, _END).mean(0)
    low, high = actions.amin(0), actions.amax(0)
    # Of an action that never varied, its own size.
    half = ((high - low) / 2).where(high > low, high.abs().where(high != 0, torch.ones_like(high)))

    def growth(actions: Tensor) -> Tensor:
        """The factor of the standard deviations under actions, ``... x 1``."""
        beyond = (low - actions).clamp_min(0) + (actions - high).clamp_min(0)
        return 1 + _BEYOND * (beyond / half).norm(dim=-1, keepdim=True)

    def changes(number: int, seed: int | None) -> Callable[[Tensor, Tensor], Tensor]:
        seed = int(torch.randint(2**31, ())) if seed is None else seed
        drawn = even_normal(number, p, seed).unsqueeze(1)  # number x 1 x p

        def change(states: Tensor, actions: Tensor) -> Tensor:
            actions = actions.expand(*states.shape[:-1], -1)
            X = spec.physics_inputs(states, actions)
            own = torch.minimum(sd * growth(actions), sd.clamp_min(_MOST))
            rows = X.flatten(0, -2).unsqueeze(1)  # each with parameters of its own
            ends = []
            for coordinates in (center + own * drawn, center.expand(*own.shape)):
                values = unknowns.at(coordinates.flatten(0, -2))
                end = states.clone()
                end[..., moving] = physics.or_nan(rows, values).view(*states.shape[:-1], -1)
                ends.append(end)
            return spec.change(ends[1], ends[0])

        return change

    return changes
