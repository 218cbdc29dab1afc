"""A system's dynamics and its goal."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import check_kind, checked_bounds, checked_number, checked_whole
from gpadjust.control.action_rate import ActionRate
from gpadjust.dynamics import Dynamics
from gpadjust.dynamics.base import step_or_nan
from gpadjust.states import Sensors, StateSpec

Reward = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Rewards ``N`` of states, actions and next states, ``N`` rows each."""

Termination = Callable[[Tensor], Tensor]
"""Whether states ``N x state_dim`` end an episode, ``N`` booleans."""

Reference = Callable[[Tensor, Tensor], Tensor]
"""Values of the exogenous states after a step, of the states before it and its number, from 1."""
Constraints = Callable[[Tensor, Tensor], Tensor]
"""Numbers ``N x c`` of states and actions that led to them, ``N`` rows each; 0 or less is right."""

InitialStates = Callable[[int], Tensor]
"""Draws ``n`` states at which episodes start, ``n x state_dim``."""


class Step(NamedTuple):
    """Result of a step from ``N`` states.

    Args:
        next_states: ``N x state_dim``; the old state where the step left the bounds.
        rewards: ``N``; where it did, that of staying.
        terminated: ``N`` booleans: whether the next state ends the episode; not where it left.
        left_bounds: ``N`` booleans: whether it would have left the bounds or the finite numbers, or
            the physics failed.
        overshoot: ``N``: how far it would have, in halves of the width between the bounds, summed
            over the states; with its gradient, which leads back. 0 where that is not finite.
        violation: ``N``: how far the constraints with their margins are violated, in sum; 0 where
            they hold.
    """

    next_states: Tensor
    rewards: Tensor
    terminated: Tensor
    left_bounds: Tensor
    overshoot: Tensor
    violation: Tensor


@dataclass(frozen=True, eq=False)
class Task:
    """The dynamics of a system with its reward, bounds and starts.

    All tensors are float64, in the units of ``dynamics.spec``. What is left out a learner takes
    from its environment and the real episodes that it has seen. To change a part, make another one
    by ``dataclasses.replace``. Dynamics learn: make others for another run.

    Args:
        dynamics: The model of the real system.
        reward: Known rewards ``N`` of states ``N x state_dim``, actions ``N x action_dim`` and next
            states ``N x state_dim``.
        terminated: Whether states ``N x state_dim`` end an episode, ``N`` booleans. Default: none.
        initial_states: Draws ``n`` states, ``n x state_dim``, at which episodes start. Default:
            those at which real episodes started.
        episode_length: Steps after which an episode is truncated, in the model and by an
            :class:`Agent`. Default: the time limit of the environment.
        state_bounds: Lower and upper bounds of the states, ``2 x state_dim``, beyond which the
            model is not followed; infinite where there is none. Default: far beyond all that was
            seen, of an agent that has seen some; else none.
        sensors: What is measured of the states, of which observations then are; it takes
            ``initial_states``. Default: all of the states.
        reference: Set-points that move during an episode, such as
            ``lambda states, steps: torch.sin(0.1 * steps).unsqueeze(-1)``: the values of the
            exogenous states, ``N x len(spec.exogenous)``, after ``steps`` steps of an episode,
            ``N``, of which the last was made at ``states``, ``N x state_dim``. The environment
            observes them; plans know them beforehand. Default: they stay as they are.
        constraints: Numbers ``N x c``, in PyTorch's functions, of states ``N x state_dim`` and the
            actions ``N x action_dim`` that led to them: each constraint holds where its number is
            at most 0, such as ``states[:, :1] - 0.5`` before a wall at 0.5. A planner looks for
            plans that hold them, or violate them least. Default: none.
        probability: Of all constraints holding through a whole episode: plans keep a margin for
            what is not known of the next states (:func:`~gpadjust.control.constraints.margins`).
            None: they hold in the mean of the model, without margin.
        action_rate: The most that an action changes in a step, one number for all actions or one
            for each; or an :class:`ActionRate`, which may have a price, too. Default: no limit.

    Raises:
        TypeError: If something is of another kind, or a function takes other arguments.
        ValueError: If a number or the bounds are out of range, or there are sensors of no such
            states, or without ``initial_states``.

    Example:
        >>> import torch
        >>> from gpadjust.control import Task
        >>> from gpadjust.dynamics import LearnedDynamics, StateSpec
        >>> dynamics = LearnedDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + 0.1 * X[:, 1:])
        >>> task = Task(dynamics, lambda states, actions, next_states: -next_states[:, 0].square())
    """

    dynamics: Dynamics
    reward: Reward
    _: KW_ONLY
    terminated: Termination | None = None
    initial_states: InitialStates | None = None
    episode_length: int | None = None
    state_bounds: Tensor | None = None
    sensors: Sensors | None = None
    reference: Reference | None = None
    constraints: Constraints | None = None
    probability: float | None = 0.95
    action_rate: ActionRate | float | Sequence[float] | None = None

    def __post_init__(self) -> None:
        """Check what can be checked without a state."""
        check_kind("dynamics", self.dynamics, Dynamics, "an object of a Dynamics")
        if self.reward is None:
            raise TypeError(
                "reward must be a function of states, actions, next states; found None."
            )
        arguments = {"reward": 3, "terminated": 1, "initial_states": 1}
        for name, number in (arguments | {"reference": 2, "constraints": 2}).items():
            _check_function(getattr(self, name), name, number)
        spec, hidden = self.dynamics.spec, self.sensors is not None
        if self.reference is not None and not spec.exogenous:
            raise ValueError(
                "reference says the values of exogenous states, but the spec has none; name the "
                "set-points among `exogenous`, and let the environment observe them."
            )
        if self.episode_length is not None:
            checked_whole("episode_length", self.episode_length, 1)
        if self.state_bounds is not None:
            bounds = checked_bounds("state_bounds", self.state_bounds, spec.state_dim, finite=False)
            object.__setattr__(self, "state_bounds", bounds)
        check_kind("sensors", self.sensors, Sensors | None, 'Sensors(["x", "theta"]), say')
        self.observed  # noqa: B018 - checks the names
        if hidden and self.initial_states is None:
            raise ValueError(
                "Of hidden states it must be known where episodes start; pass initial_states, or "
                "start of a System, as well as sensors."
            )
        if hidden and self.reference is not None:
            raise ValueError(
                "The estimate of hidden states takes set-points for constant; leave reference out, "
                "or the sensors."
            )
        if self.probability is not None:
            checked_number("probability", self.probability, above=0, below=1)
        if self.rate is not None:
            self.rate.check(spec.action_dim)

    @property
    def observed(self) -> StateSpec:
        """What is observed, as a spec: the states, or the outputs of the sensors."""
        spec = self.dynamics.spec
        return spec if self.sensors is None else self.sensors.spec(spec)

    @property
    def rate(self) -> ActionRate | None:
        """``action_rate`` as an object, None if there is none."""
        given = self.action_rate
        return given if isinstance(given, ActionRate | None) else ActionRate(given)

    def try_functions(self, states: Tensor, actions: Tensor) -> None:
        """Call physics and functions once, to find what is wrong with them before it costs data.

        Args:
            states: Where episodes start, ``N x state_dim``.
            actions: Some that may be taken there, ``N x action_dim``.

        Raises:
            ValueError: If they return another shape, or numbers that are not finite.
            PhysicsError: If the physics fails.
        """
        if self.initial_states is not None:
            self.draw_initial_states(len(states))
        if self.sensors is not None:
            self.sensors.measure(self.dynamics.spec, states)
        self.rewards(states, actions, states)
        self.terminations(states)
        self.set_points(states, torch.ones(len(states), dtype=torch.long))
        self.constraint_values(states, actions)
        self.dynamics.try_physics(states, actions)

    def check_spaces(self, observation_space: Any, action_space: Any) -> None:
        """Raise a ValueError unless the spaces are boxes of what is observed and of actions."""
        spec, whose = self.observed, "dynamics" if self.sensors is None else "sensors"
        for name, space, size in (
            ("observation", observation_space, spec.observation_dim),
            ("action", action_space, spec.action_dim),
        ):
            if not hasattr(space, "high") or space.shape != (size,):
                raise ValueError(
                    f"The spec of the {whose} says that the {name} has {size} entries, so a Box "
                    f"of shape ({size},) is expected; found {space}. States: {tuple(spec.states)}, "
                    f"of which angles (seen as sine and cosine): {tuple(spec.angles)}; actions: "
                    f"{tuple(spec.actions)}."
                )
        if not np.isfinite([action_space.low, action_space.high]).all():
            raise ValueError(
                "Actions must have bounds, between which plans and policies choose; found "
                f"{action_space}. Set env.action_space = gymnasium.spaces.Box(low, high) with "
                "those of the machine."
            )

    def refuse(self, learner: str, name: str, way_out: str) -> None:
        """Raise a ValueError if the task has a part of this name, with which a learner cannot do.

        Args:
            learner: The name of the learner.
            name: That of the part.
            way_out: Who can.
        """
        if getattr(self, name) is not None:
            raise ValueError(f"{learner} cannot learn a task with {name}; {way_out}.")

    def draw_initial_states(self, n: int) -> Tensor:
        """Draw ``n x state_dim`` states at which episodes start.

        Raises:
            ValueError: If there is no function that draws them, or they have another shape, or are
                not finite.
        """
        if self.initial_states is None:
            raise ValueError("The task does not say where episodes start; pass initial_states.")
        states = torch.as_tensor(self.initial_states(n), dtype=torch.float64)
        if states.shape != (n, self.dynamics.spec.state_dim):
            raise ValueError(
                f"initial_states({n}) must return states of shape {n} x "
                f"{self.dynamics.spec.state_dim}; found {tuple(states.shape)}."
            )
        if not states.isfinite().all():
            row = int((~states.isfinite()).any(-1).nonzero()[0])
            raise ValueError(
                f"initial_states({n}) must return finite states; found {states[row].tolist()}."
            )
        return states

    def rewards(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """The known rewards ``N`` of transitions, checked; with their gradient to the states."""
        rewards = per_row(self.reward(states, actions, next_states), len(states), "reward")
        return rewards if next_states.requires_grad else rewards.detach()

    def terminations(self, states: Tensor) -> Tensor:
        """Return the terminations in states ``N x state_dim``, checked: ``N`` booleans."""
        if self.terminated is None:
            return torch.zeros(len(states), dtype=torch.bool)
        return per_row(self.terminated(states.detach()), len(states), "terminated").bool()

    def set_points(self, states: Tensor, steps: Tensor | int) -> Tensor | None:
        """Return the exogenous states after a step, ``N x len(spec.exogenous)``, checked.

        Args:
            states: Those before the step, ``N x state_dim``.
            steps: The number of the step, from 1, ``N`` or one for all.

        Returns:
            Their values; None without a ``reference``, as they stay.
        """
        if self.reference is None:
            return None
        numbers = torch.as_tensor(steps).expand(len(states))
        found = torch.as_tensor(self.reference(states.detach(), numbers), dtype=torch.float64)
        shape = (len(states), len(self.dynamics.spec.exogenous))
        if found.shape != shape or not found.isfinite().all():
            raise ValueError(
                f"reference(states, steps) must return finite values of shape {shape}, a column "
                f"for each of {tuple(self.dynamics.spec.exogenous)}; found "
                f"{tuple(found.shape) if found.shape != shape else found.tolist()}."
            )
        return found

    def constraint_values(self, states: Tensor, actions: Tensor) -> Tensor:
        """The values of the constraints, checked: ``N x c`` with their gradient, ``N x 0`` of none.

        Args:
            states: ``N x state_dim``.
            actions: The actions that led to them, ``N x action_dim``.
        """
        if self.constraints is None:
            return states.new_zeros(len(states), 0)
        values = torch.as_tensor(self.constraints(states, actions))
        if values.dtype == torch.bool:
            raise TypeError(
                "constraints must return numbers that are at most 0 where they hold, such as "
                "states[:, :1] - 0.4; found booleans."
            )
        if values.dim() != 2 or len(values) != len(states):
            raise ValueError(
                f"constraints must return a column for each constraint, shape ({len(states)}, c); "
                f"found {tuple(values.shape)}."
            )
        per_row(values.detach().sum(-1), len(states), "constraints")
        return values

    def step(
        self,
        states: Tensor,
        actions: Tensor,
        move: Callable[[Tensor, Tensor], Tensor] | None = None,
        *,
        set_points: Tensor | None = None,
        margins: Tensor | None = None,
        some_must_succeed: bool = False,
    ) -> Step:
        """Take actions ``N x action_dim`` at states ``N x state_dim`` of the model.

        Args:
            states: The states.
            actions: The actions.
            move: Next states of these. Default: drawn from the dynamics, row by row.
            set_points: The exogenous states afterwards, see :meth:`set_points`. Default: as before.
            margins: Of the constraints, ``c``. Default: none.
            some_must_succeed: Whether it is an error that the physics fails for all rows.

        Raises:
            PhysicsError: If the physics does not say where it fails; or fails everywhere, though it
                must not.
        """
        move = self.dynamics.sample if move is None else move
        following = step_or_nan(move, states, actions, some_must_succeed=some_must_succeed)
        if set_points is not None:
            following = following.clone()
            following[:, self.dynamics.spec.exogenous_columns] = set_points
        left = ~following.isfinite().all(-1)
        none = following.new_zeros(len(following))
        overshoot = violation = none
        if self.state_bounds is not None:
            low, high = self.state_bounds
            beyond = (low - following).clamp_min(0.0) + (following - high).clamp_min(0.0)
            outside = (beyond > 0).any(-1)
            if outside.any():
                left = left | outside
                width = (high - low) / 2
                beyond = beyond / torch.where(width.isfinite(), width, 1.0)
                overshoot = torch.where(beyond.isfinite(), beyond, 0.0).sum(-1)
        ended = none.bool()
        if left.any():
            following = torch.where(left.unsqueeze(-1), states, following)
        rewards = self.rewards(states, actions, following)
        if self.terminated is not None:
            ended = self.terminations(following) & ~left
        if self.constraints is not None:
            values = self.constraint_values(following, actions)
            violation = (values if margins is None else values + margins).clamp_min(0.0).sum(-1)
        return Step(following, rewards, ended, left, overshoot, violation)

    def widened(self, states: Tensor) -> Task:
        """This task, or one whose bounds give way to states ``N x state_dim`` beyond them."""
        if self.state_bounds is None:
            return self
        low, high = self.state_bounds
        span = torch.where((high - low).isfinite(), high - low, 0.0)
        slack = 1e-5 * span  # observations have single precision
        wider = ((states < low - slack) | (states > high + slack)).any(0)
        if not wider.any():
            return self
        room = span / 2
        low = torch.where(wider, torch.minimum(low, states.amin(0) - room), low)
        high = torch.where(wider, torch.maximum(high, states.amax(0) + room), high)
        return replace(self, state_bounds=torch.stack([low, high]))

    def describe(self) -> dict[str, Any]:
        """Return the task in plain values: of functions, whether there is one."""
        bounds = self.state_bounds
        return {
            **{f"dynamics.{name}": text for name, text in self.dynamics.describe().items()},
            "terminated": self.terminated is not None,
            "initial_states": self.initial_states is not None,
            "episode_length": self.episode_length,
            "state_bounds": None if bounds is None else bounds.tolist(),
            "sensors": None if self.sensors is None else self.sensors.describe(),
            "reference": self.reference is not None,
            "constraints": self.constraints is not None,
            "probability": self.probability,
            "action_rate": None if self.action_rate is None else repr(self.action_rate),
        }


def per_row(values: Any, n: int, name: str) -> Tensor:
    """Check what a function of the user's says of ``n`` rows."""
    values = torch.as_tensor(values)
    if values.shape != (n,):
        raise ValueError(
            f"{name} must return one value per row, shape ({n},); found {tuple(values.shape)}."
        )
    if not values.isfinite().all():
        row = int((~values.isfinite()).nonzero()[0])
        raise ValueError(f"{name} returned {values[row]} for row {row}; expected finite numbers.")
    return values


def _check_function(function: Any, name: str, num_arguments: int) -> None:
    """Raise a TypeError unless a function of the user's takes what it will be given, or is None."""
    if function is None:
        return
    if not callable(function):
        raise TypeError(f"{name} must be a function; found {function!r}.")
    try:
        signature = inspect.signature(function)
    except ValueError:  # some compiled functions have none
        return
    try:
        signature.bind(*range(num_arguments))
    except TypeError as error:
        raise TypeError(
            f"{name} is called with {num_arguments} argument(s); found {name}{signature}."
        ) from error
