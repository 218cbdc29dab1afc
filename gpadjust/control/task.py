"""A system's dynamics and its goal, and one step of it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import check_kind, checked_bounds, checked_number, checked_whole
from gpadjust.dynamics import Dynamics
from gpadjust.dynamics.base import step_or_nan
from gpadjust.states import Sensors, StateSpec

_ROUNDING = 1e-5  # of the width of the bounds: observations have single precision
_FUNCTIONS = {
    "reward": ("states", "actions", "next states"),
    "terminated": ("states",),
    "initial_states": ("a number",),
    "reference": ("states", "numbers of steps"),
    "constraints": ("states", "actions that led to them"),
}
"""Functions of the user, with their arguments."""


@dataclass(frozen=True)
class ActionRate:
    """Limit and price of the change of an action between two steps; the first action is free.

    Args:
        most: Largest change in a step, one number for all actions or one for each. Default: none.
        price: Cost of a unit of the sum of squared changes, in addition to the rewards.

    Raises:
        TypeError: If a number has another type.
        ValueError: If ``most`` is not positive, or ``price`` negative.

    Example:
        >>> ActionRate(most=0.25).limited(torch.tensor([1.0, -0.1]), torch.zeros(2))
        tensor([ 0.2500, -0.1000])
    """

    most: float | Sequence[float] | None = None
    _: KW_ONLY
    price: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        for limit in self.limits:
            checked_number("the most of an action rate", limit, above=0)
        checked_number("price", self.price, least=0)

    @property
    def limits(self) -> list[Any]:
        """The limits as a list; empty without a limit."""
        if self.most is None:
            return []
        is_list = isinstance(self.most, Sequence) and not isinstance(self.most, str)
        return [*self.most] if is_list else [self.most]  # type: ignore[misc]

    def limited(self, actions: Tensor, before: Tensor | None) -> Tensor:
        """Return the nearest actions ``... x action_dim`` that may follow the ones before."""
        if self.most is None or before is None:
            return actions
        most = torch.tensor(self.limits, dtype=actions.dtype)
        return before + (actions - before).clamp(-most, most)


class Moment(NamedTuple):
    """The point of an episode at which a step is made, of ``N`` rows or one for all of them.

    ``margins`` are those of the constraints in the steps ahead, ``T x c``, the last one for all
    further steps; see :func:`~gpadjust.control.constraints.margins`.
    """

    steps_done: Any = 0  #: number of earlier steps, N
    action: Tensor | None = None  #: the last one, N x action_dim; None at the start
    margins: Tensor | None = None

    def after(self, actions: Tensor) -> Moment:
        """Return the moment after a step with these actions."""
        margins = self.margins
        if margins is not None and len(margins) > 1:
            margins = margins[1:]
        return Moment(self.steps_done + 1, actions, margins)


class Steps(NamedTuple):
    """Steps in a model: ``N`` of them, or ``k x n x T``, of ``n`` episodes in ``k`` functions.

    Where a step left the bounds or the finite numbers, or the physics failed, the next state is the
    old one, and the reward that of staying. A step is not made there, nor after the end of an
    episode, where its other entries mean nothing. The overshoot, the distance beyond the bounds in
    halves of their width summed over the states, has a gradient that leads back.
    """

    states: Tensor  #: at which actions were taken, ... x state_dim
    actions: Tensor  #: within the limits of the action rate, ... x action_dim
    next_states: Tensor  #: ... x state_dim
    rewards: Tensor  #: ..., as all that follow
    made: Tensor  #: True if the step was made
    terminated: Tensor  #: True if the next state ends the episode
    left_bounds: Tensor  #: True if it would have left the bounds
    overshoot: Tensor  #: 0 where it is not finite
    violation: Tensor  #: sum over the constraints with their margins; 0 if they hold
    price: Tensor  #: of the change of the action


@dataclass(frozen=True, eq=False)
class Task:
    """The dynamics of a system with its reward, bounds and starts.

    All tensors are float64, in the units of ``dynamics.spec``. A learner completes missing parts
    from its environment and real episodes. Dynamics learn: make new ones for another run.

    Args:
        dynamics: The model of the real system.
        reward: Rewards ``N`` of states ``N x state_dim``, actions ``N x action_dim`` and next
            states ``N x state_dim``.
        terminated: ``N`` booleans, True where states ``N x state_dim`` end an episode. Default:
            nowhere.
        initial_states: Draws ``n`` states, ``n x state_dim``, at which episodes start. Default:
            the starts of real episodes.
        episode_length: Number of steps after which an episode is truncated, in the model and by an
            :class:`Agent`. Default: the time limit of the environment.
        state_bounds: Lower and upper bounds of the states, ``2 x state_dim``, beyond which the
            model is not followed; infinite without a bound. Default: far beyond the recorded
            states of an agent with real episodes; else none.
        sensors: The measured outputs, which then are the observations; needs ``initial_states``.
            Default: all states are measured.
        reference: Set-points that move during an episode, such as
            ``lambda states, steps: torch.sin(0.1 * steps).unsqueeze(-1)``: the values of the
            exogenous states, ``N x len(spec.exogenous)``, after ``steps`` steps of an episode,
            ``N``, the last of them at ``states``, ``N x state_dim``. The environment observes them;
            plans use them in advance. Default: constant set-points.
        constraints: Numbers ``N x c``, in PyTorch's functions, of states ``N x state_dim`` and the
            actions ``N x action_dim`` that led to them: each constraint holds where its number is
            at most 0, such as ``states[:, :1] - 0.5`` before a wall at 0.5. Default: none.
        probability: Probability that all constraints hold through an episode, for which plans keep
            :func:`~gpadjust.control.constraints.margins`. None: they hold in the mean of the model.
        action_rate: Largest change of an action in a step, one number for all actions or one for
            each; or an :class:`ActionRate`. Default: no limit.

    Raises:
        TypeError: If a part has another type, or a function takes other arguments.
        ValueError: If a number or the bounds are out of range, or parts contradict each other.

    Example:
        >>> from gpadjust.dynamics import LearnedDynamics
        >>> dynamics = LearnedDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + 0.1 * X[:, 1:])
        >>> task = Task(dynamics, lambda states, actions, next_states: -next_states[:, 0].square())
    """

    dynamics: Dynamics
    reward: Callable[[Tensor, Tensor, Tensor], Tensor]
    _: KW_ONLY
    terminated: Callable[[Tensor], Tensor] | None = None
    initial_states: Callable[[int], Tensor] | None = None
    episode_length: int | None = None
    state_bounds: Tensor | None = None
    sensors: Sensors | None = None
    reference: Callable[[Tensor, Tensor], Tensor] | None = None
    constraints: Callable[[Tensor, Tensor], Tensor] | None = None
    probability: float | None = 0.95
    action_rate: ActionRate | float | Sequence[float] | None = None

    def __post_init__(self) -> None:
        """Check what needs no state."""
        check_kind("dynamics", self.dynamics, Dynamics, "an object of a Dynamics")
        check_kind("sensors", self.sensors, Sensors | None, 'Sensors(["x", "theta"])')
        for name, arguments in _FUNCTIONS.items():
            function = getattr(self, name)
            if (function is not None or name == "reward") and not _takes(function, len(arguments)):
                raise TypeError(
                    f"{name} must be a function of {', '.join(arguments)}; found {function!r}."
                )
        if self.episode_length is not None:
            checked_whole("episode_length", self.episode_length, 1)
        if self.probability is not None:
            checked_number("probability", self.probability, above=0, below=1)
        if self.state_bounds is not None:
            size = self.dynamics.spec.state_dim
            bounds = checked_bounds("state_bounds", self.state_bounds, size, finite=False)
            object.__setattr__(self, "state_bounds", bounds)
        self.observed  # noqa: B018 - raises an error for unknown names of the sensors
        for message in self._mistakes():
            raise ValueError(message)

    def _mistakes(self) -> Iterator[str]:
        """Return messages on parts that contradict each other."""
        spec = self.dynamics.spec
        if self.reference is not None and not spec.exogenous:
            yield (
                "reference returns the values of exogenous states, but the spec has none; name the "
                "set-points among `exogenous`, and let the environment observe them."
            )
        if self.sensors is not None and self.initial_states is None:
            yield (
                "Hidden states need known starts of episodes: give initial_states (of a System, "
                "start) in addition to sensors."
            )
        if self.sensors is not None and self.reference is not None:
            yield "Hidden states need constant set-points: give reference or sensors, not both."
        if self.rate is not None and len(self.rate.limits) not in (0, 1, spec.action_dim):
            yield (
                f"action_rate must have one limit, or one for each of {spec.action_dim} actions; "
                f"found {len(self.rate.limits)}."
            )

    @property
    def observed(self) -> StateSpec:
        """The spec of observations: of the states, or of the outputs of the sensors."""
        spec = self.dynamics.spec
        return spec if self.sensors is None else self.sensors.spec(spec)

    @property
    def rate(self) -> ActionRate | None:
        """``action_rate`` as an object, or None."""
        rate = self.action_rate
        return rate if isinstance(rate, ActionRate | None) else ActionRate(rate)

    def step(
        self,
        states: Tensor,
        actions: Tensor,
        moment: Moment | None = None,
        *,
        move: Callable[[Tensor, Tensor], Tensor] | None = None,
        some_must_succeed: bool = False,
    ) -> Steps:
        """Take actions ``N x action_dim`` at states ``N x state_dim``, at a moment of an episode.

        This is the one place where action rate, set-points, bounds and constraints act. ``move``
        returns the next states, by default a draw of the dynamics.

        Raises:
            PhysicsError: If the physics does not report where it fails, or fails for all rows and
                ``some_must_succeed``.
        """
        moment = moment or Moment()
        zeros = torch.zeros(len(states), dtype=torch.float64)
        # The action rate: the nearest action within the limit, at the price of its change.
        price = zeros
        if self.rate is not None and moment.action is not None:
            actions = self.rate.limited(actions, moment.action)
            price = self.rate.price * (actions - moment.action).square().sum(-1)
        following = step_or_nan(
            move or self.dynamics.sample, states, actions, some_must_succeed=some_must_succeed
        )
        # Set-points are known in advance.
        set_points = self.set_points(states, moment.steps_done + 1)
        if set_points is not None:
            following = following.clone()
            following[:, self.dynamics.spec.exogenous_columns] = set_points
        # Beyond the bounds a state stays as it was.
        left, overshoot = self._left_bounds(following)
        if left.any():
            following = torch.where(left.unsqueeze(-1), states, following)
        rewards = self.rewards(states, actions, following)
        terminated = zeros.bool()
        if self.terminated is not None:
            terminated = self.terminations(following) & ~left
        # A constraint holds with its margin: g + margin <= 0
        violation = zeros
        if self.constraints is not None:
            values = self.constraint_values(following, actions)
            if moment.margins is not None:
                values = values + moment.margins[0]
            violation = values.clamp_min(0.0).sum(-1)
        ends = (~left, terminated, left, overshoot)
        return Steps(states, actions, following, rewards, *ends, violation, price)

    def _left_bounds(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return which states are beyond the bounds or not finite, and how far beyond."""
        left = ~states.isfinite().all(-1)
        overshoot = states.new_zeros(len(states))
        if self.state_bounds is None:
            return left, overshoot
        low, high = self.state_bounds
        beyond = (low - states).clamp_min(0.0) + (states - high).clamp_min(0.0)
        outside = (beyond > 0).any(-1)
        if outside.any():
            width = (high - low) / 2
            beyond = beyond / torch.where(width.isfinite(), width, 1.0)
            overshoot = torch.where(beyond.isfinite(), beyond, 0.0).sum(-1)
        return left | outside, overshoot

    def widened(self, states: Tensor) -> Task:
        """Return this task, or one with wider bounds if states ``N x state_dim`` are beyond."""
        if self.state_bounds is None:
            return self
        low, high = self.state_bounds
        span = torch.where((high - low).isfinite(), high - low, 0.0)
        slack = _ROUNDING * span
        wider = ((states < low - slack) | (states > high + slack)).any(0)
        if not wider.any():
            return self
        low = torch.where(wider, torch.minimum(low, states.amin(0) - span / 2), low)
        high = torch.where(wider, torch.maximum(high, states.amax(0) + span / 2), high)
        return replace(self, state_bounds=torch.stack([low, high]))

    # The user's functions, checked

    def draw_initial_states(self, n: int) -> Tensor:
        """Draw ``n x state_dim`` states at which episodes start; a ValueError if unknown."""
        if self.initial_states is None:
            raise ValueError("The task has no starts of episodes; give initial_states.")
        drawn = torch.as_tensor(self.initial_states(n), dtype=torch.float64)
        return checked_values(f"initial_states({n})", drawn, n, self.dynamics.spec.state_dim)

    def rewards(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
        """Return the rewards ``N`` of transitions, with their gradient to the states."""
        rewards = checked_values("reward", self.reward(states, actions, next_states), len(states))
        return rewards if next_states.requires_grad else rewards.detach()

    def terminations(self, states: Tensor) -> Tensor:
        """Return the terminations in states ``N x state_dim``: ``N`` booleans."""
        if self.terminated is None:
            return torch.zeros(len(states), dtype=torch.bool)
        return checked_values("terminated", self.terminated(states.detach()), len(states)).bool()

    def set_points(self, states: Tensor, steps: Tensor | int) -> Tensor | None:
        """Return exogenous states ``N x len(spec.exogenous)`` after these steps, or None."""
        if self.reference is None:
            return None
        values = self.reference(states.detach(), torch.as_tensor(steps).expand(len(states)))
        values = torch.as_tensor(values, dtype=torch.float64)
        exogenous = self.dynamics.spec.exogenous
        return checked_values("reference(states, steps)", values, len(states), len(exogenous))

    def constraint_values(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the constraints ``N x c`` in states and the actions that led to them."""
        if self.constraints is None:
            return states.new_zeros(len(states), 0)
        values = torch.as_tensor(self.constraints(states, actions))
        if values.dtype == torch.bool:
            raise TypeError(
                "constraints must return numbers that are at most 0 where they hold, such as "
                "states[:, :1] - 0.4; found booleans."
            )
        return checked_values("constraints", values, len(states), "c")

    # Before and between real steps

    def try_functions(self, states: Tensor, actions: Tensor) -> None:
        """Call physics and functions once at ``N`` rows, for their errors before real steps."""
        if self.initial_states is not None:
            self.draw_initial_states(len(states))
        if self.sensors is not None:
            self.sensors.measure(self.dynamics.spec, states)
        self.step(states, actions, move=lambda states, actions: states)
        self.dynamics.try_physics(states, actions)

    def check_spaces(self, observation_space: Any, action_space: Any) -> None:
        """Raise a ValueError unless the spaces are boxes of observations and actions."""
        spec = self.observed
        owner = "dynamics" if self.sensors is None else "sensors"
        spaces = {"observation": observation_space, "action": action_space}
        sizes = (spec.observation_dim, spec.action_dim)
        for (name, space), size in zip(spaces.items(), sizes, strict=True):
            if not hasattr(space, "high") or space.shape != (size,):
                raise ValueError(
                    f"By the spec of the {owner} the {name} has {size} entries (sine and cosine of "
                    f"an angle), so a Box of shape ({size},) is expected; found {space}. {spec}."
                )
        if not np.isfinite([action_space.low, action_space.high]).all():
            raise ValueError(
                f"Actions must have finite bounds, for plans and policies; found {action_space}. "
                "Set env.action_space = gymnasium.spaces.Box(low, high)."
            )

    def refuse(self, learner: str, name: str, way_out: str) -> None:
        """Raise a ValueError if the task has the part ``name``, which a learner cannot use."""
        if getattr(self, name) is not None:
            raise ValueError(f"{learner} cannot learn a task with {name}; {way_out}.")

    def describe(self) -> dict[str, Any]:
        """Return the task in plain values, with True for a function."""
        bounds, sensors, rate = self.state_bounds, self.sensors, self.action_rate
        return {
            **{f"dynamics.{name}": text for name, text in self.dynamics.describe().items()},
            **{name: getattr(self, name) is not None for name in _FUNCTIONS if name != "reward"},
            "episode_length": self.episode_length,
            "state_bounds": None if bounds is None else bounds.tolist(),
            "sensors": sensors and sensors.describe(),
            "probability": self.probability,
            "action_rate": None if rate is None else repr(rate),
        }


def checked_values(function: str, values: Any, *shape: int | str) -> Tensor:
    """Return a user's values as a tensor; raise a ValueError for another shape or NaN.

    A letter in the shape is any number of columns.
    """
    values = torch.as_tensor(values)
    columns = values.shape[-1:] if shape[-1] == "c" else shape[-1:]
    if values.shape != (*shape[:-1], *columns):
        size = " x ".join(map(str, shape))
        expected = f"values of shape {size}" if shape[1:] else f"one value per row, shape ({size},)"
        raise ValueError(f"{function} must return {expected}; found {tuple(values.shape)}.")
    if not values.isfinite().all():
        row = int((~values.isfinite()).nonzero()[0, 0])
        raise ValueError(
            f"{function} returned {values[row].tolist()} for row {row}; expected finite numbers."
        )
    return values


def _takes(function: Any, num_arguments: int) -> bool:
    """Return True for a function of so many arguments."""
    try:
        inspect.signature(function).bind(*range(num_arguments))
    except TypeError:
        return False
    except ValueError:  # some compiled functions have no signature
        pass
    return True
