"""Dynamics by a physics alone, with or without unknown parameters, and the physics of a step."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import checked_number, checked_tensor, checked_whole
from gpadjust.core import Prediction
from gpadjust.dynamics.base import Dynamics, Sampler, TransitionFunctions
from gpadjust.dynamics.least_squares import most_likely
from gpadjust.dynamics.state import check_numbers, columns_of, fingerprint, loading
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import Physics, PhysicsError, as_physics
from gpadjust.physics.parameters import PhysicsParameters, even_normal
from gpadjust.states import StateSpec

_DRAWS = 1024
_PROBES = 3
_OF_SPREAD = 1e-4  # tolerance between machines, as a share of the spread of changes
_OF_SIZE = 1e-6  # the same, as a share of the size of states and changes
_BEYOND = 2.0  # growth of a variation, per half range of the actions outside of the range
_MOST = 0.5  # standard deviations of a parameter's prior
_END = 8.0  # largest coordinate; a prior has no mass beyond


class PhysicsDynamics(Dynamics):
    r"""The physics alone, with the most likely values of its unknown parameters.

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
            state, for predictions before the first fit.

    Raises:
        TypeError: If ``spec`` or ``physics`` has another type.
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

        Their ``sd`` are the standard errors.
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
        """Load a result of :meth:`state_dict`; errors as of :class:`LearnedDynamics`."""
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


class PhysicsProbes(NamedTuple):
    """A few transitions, and changes by a physics there, at the guesses of its parameters."""

    states: Tensor  # k x state_dim
    actions: Tensor  # k x action_dim
    changes: Tensor  # of the states that move, k x m
    tolerance: Tensor  # largest difference of the same physics, m

    @classmethod
    def from_data(cls, physics: Physics, spec: StateSpec, data: Trajectories) -> PhysicsProbes:
        """Return the row with the least usual output of the physics of each third of the rows.

        Warn if the physics seems to return changes.
        """
        with torch.no_grad():
            following = next_values(physics, spec, data.states, data.actions)
        warn_of_differences(physics.name, spec, data, following)
        changes = spec.change(data.states, following)[:, spec.moving]
        deviation = (changes - changes.mean(0)).abs()
        spread = deviation.square().mean(0).sqrt()
        # The largest deviation of a row in standard deviations: the least usual row tells most.
        unusual = (deviation / spread.clamp_min(torch.finfo(spread.dtype).tiny)).amax(-1)
        parts = [rows for rows in torch.arange(len(data)).tensor_split(_PROBES) if len(rows)]
        probes = torch.stack([rows[unusual[rows].argmax()] for rows in parts])
        size = torch.cat([data.states[:, spec.moving], changes]).abs().amax(0)
        tolerance = _OF_SPREAD * spread + _OF_SIZE * size
        return cls(data.states[probes], data.actions[probes], changes[probes], tolerance)

    def check(self, physics: Physics, spec: StateSpec) -> None:
        """Raise a PhysicsError, which is a RuntimeError, if a physics returns something else."""
        check_numbers(self._asdict())
        physics.forget()  # a file or a program may have changed since
        with torch.no_grad():
            following = next_values(physics, spec, self.states, self.actions)
        # Predicted changes within the tolerance; angles the shortest way round.
        expected = self.states.clone()
        expected[:, spec.moving] += self.changes
        gap = spec.change(expected, following)[:, spec.moving].abs()
        if (gap <= self.tolerance).all():
            return
        row, column = divmod(int((gap - self.tolerance).argmax()), gap.shape[-1])
        i = spec.moving[column]
        raise PhysicsError(
            f"The saved dynamics have another physics than {physics.name!r} here. In the state "
            f"{self.states[row].tolist()}, with the action {self.actions[row].tolist()}, that one "
            f"returned {float(expected[row, i]):.6g} for {spec.states[i]!r}, this one returns "
            f"{float(following[row, i]):.6g}. Load the state into dynamics with the same physics, "
            "a deterministic one, or update new dynamics by its transitions."
        )


def named_physics(physics: Any, spec: StateSpec) -> dict[str, Physics]:
    """Return checked physics of next states by name, from one, a list or a mapping."""
    named: Any = physics
    if not isinstance(named, Mapping):
        several = physics if isinstance(physics, list | tuple) else [physics]
        named = {str(i + 1): function for i, function in enumerate(several)}
    parts: dict[str, Physics] = {}
    for name, function in named.items():
        part = function
        if not isinstance(function, Physics):
            part = as_physics(function)
            if isinstance(physics, Mapping):
                part.name = name
        parts[name] = part
        steps = [step for step in (part.step, spec.step) if step is not None]
        if len(steps) == 2 and not math.isclose(*steps, rel_tol=1e-6):
            raise ValueError(
                f"Physics {part.name!r} has steps of {part.step:g}, but the spec has "
                f"{spec.step:g}; build it with step={spec.step:g}, or correct the spec."
            )
    return parts


def one_physics(physics: Any, spec: StateSpec, otherwise: str) -> Physics:
    """Return a physics of next states; raise a ValueError, with the way out, unless it is one."""
    parts = [*named_physics(physics, spec).values()]
    if len(parts) != 1:
        names = ", ".join(repr(part.name) for part in parts)
        raise ValueError(f"Expected one physics to follow, got {names}; {otherwise}.")
    return parts[0]


def next_values(
    physics: Physics, spec: StateSpec, states: Tensor, actions: Tensor, parameters: Any = None
) -> Tensor:
    """Return the next states ``... x state_dim`` by a physics; exogenous states do not change."""
    inputs = spec.physics_inputs(states, actions)
    if inputs.dim() == 1:
        inputs = inputs.unsqueeze(0)
    Y = physics(inputs, parameters)
    check_next_values(physics, Y, len(spec.moving))
    following = states.clone()
    following[..., spec.moving] = Y
    return spec.remember(following, states, actions)


def check_next_values(physics: Physics, Y: Tensor, num_states: int) -> None:
    """Raise a ValueError unless the physics returned a column for each state that moves."""
    if Y.shape[-1] != num_states:
        raise ValueError(
            f"Expected physics {physics.name!r} to return the next values of the {num_states} "
            f"states that are neither exogenous nor previous values, got {Y.shape[-1]} columns."
        )


def warn_of_differences(name: str, spec: StateSpec, data: Trajectories, following: Tensor) -> None:
    """Warn if outputs of a physics, read as changes, have at most a third of the error."""
    # Errors in units of the changes, of the outputs as next states and as changes.
    scale = spec.change(data.states, data.next_states).square().nanmean(0).sqrt()
    columns = [i for i in spec.moving if scale[i] > 0]
    errors = []
    for predicted in (following, data.states + following):
        error = spec.change(data.next_states, predicted) / scale
        errors.append(float(error[:, columns].square().nansum().sqrt()))
    if errors[1] < errors[0] / 3:
        warnings.warn(
            f"Physics {name!r} seems to return the change of the state, but dynamics need the next "
            f"state. Read as a change, its error is {errors[1] / errors[0]:.2g} times the error "
            "as the next state. Let it return `next state = state + change`.",
            UserWarning,
            stacklevel=4,
        )


def checked_physics_error(spec: StateSpec, errors: Mapping[str, float] | None) -> dict[str, float]:
    """Return standard deviations of the error of a step of the physics, by state."""
    errors = {} if errors is None else {**errors}
    for name, sd in errors.items():
        moving = [spec.states[i] for i in spec.moving]
        if name not in moving:
            raise ValueError(f"physics_error names states among {moving}; found {name!r}.")
        checked_number(f"physics_error[{name!r}]", sd, least=0)
    return errors


def varying_parameters(
    physics: Physics,
    spec: StateSpec,
    learnt: PhysicsParameters,
    actions: Tensor,
    variation: Tensor | float,
) -> Sampler:
    """Return a sampler of changes of the next states by varying parameters of the physics.

    The sampler takes a number ``k`` of draws and a seed. It returns a function of states and
    actions: the change of next states ``k x N x state_dim``, NaN where the physics fails. Beyond
    the actions of the updates, ``N x action_dim``, the learnt parameters vary more; the variation
    is as of :meth:`Dynamics.free_run`.
    """
    unknowns = physics.unknowns
    p = len(unknowns)
    sd = checked_tensor("variation", variation)
    if sd.shape not in ((), (p,)) or not (sd.isfinite() & (sd >= 0)).all():
        raise ValueError(
            f"Expected variation as one number of 0 or more, or one for each of "
            f"{', '.join(unknowns)}, got {sd.tolist()}."
        )
    sd = sd.expand(p)
    center = unknowns.to_coordinates(learnt.draws).clamp(-_END, _END).mean(0)
    low, high = actions.amin(0), actions.amax(0)
    # Half of the range; for an action that never varied, its size.
    size = high.abs().where(high != 0, torch.ones_like(high))
    half = ((high - low) / 2).where(high > low, size)

    def changes(number: int, seed: int | None) -> TransitionFunctions:
        if seed is None:
            seed = int(torch.randint(2**31, ()))
        normal = even_normal(number, p, seed).unsqueeze(1)  # number x 1 x p

        def change(states: Tensor, actions: Tensor) -> Tensor:
            actions = actions.expand(*states.shape[:-1], -1)
            # sd (1 + 2 |distance from the range| / half range), at most max(sd, 0.5)
            beyond = (low - actions).clamp_min(0) + (actions - high).clamp_min(0)
            growth = 1 + _BEYOND * (beyond / half).norm(dim=-1, keepdim=True)
            deviation = torch.minimum(sd * growth, sd.clamp_min(_MOST)) * normal
            rows = spec.physics_inputs(states, actions).flatten(0, -2).unsqueeze(1)
            # f_p(x; z + deviation) - f_p(x; z)
            ends = []
            for coordinates in (center, center + deviation):
                values = unknowns.to_values(  # of each row
                    coordinates.expand_as(deviation).flatten(0, -2)
                )
                end = states.clone()
                end[..., spec.moving] = physics.or_nan(rows, values).view(*states.shape[:-1], -1)
                ends.append(end)
            return spec.change(*ends)

        return change

    return changes
