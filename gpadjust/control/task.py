"""A system's dynamics and its goal, and one step of it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import check_kind, checked_bounds, checked_number, checked_whole
from gpadjust.dynamics import Dynamics
from gpadjust.dynamics.base import step_or_nan
from gpadjust.states import Sensors, StateSpec

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
    """Limit and price of the change of an action from a step to the next one.

    The first action of an episode is free.

    Args:
        most: The most that an action changes in a step, one number for all actions or one for
            each. Default: no limit.
        price: Cost of a step for each unit of the sum of its squared changes, beside the rewards.

    Raises:
        TypeError: If a number is of another kind.
        ValueError: If ``most`` is not positive, or ``price`` negative.

    Example:
        >>> import torch
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
        """The limits as a list; empty without any."""
        if isinstance(self.most, Sequence) and not isinstance(self.most, str):
            return [*self.most]
        return [] if self.most is None else [self.most]

    def limited(self, actions: Tensor, before: Tensor | None) -> Tensor:
        """Return the nearest actions ``... x action_dim`` that may follow the ones before."""
        if self.most is None or before is None:
            return actions
        most = torch.tensor(self.limits, dtype=actions.dtype)
        return before + (actions - before).clamp(-most, most)


class Moment(NamedTuple):
    """The point of an episode at which a step is made.

    Args:
        steps_done: Number of steps before, ``N`` or one for all rows.
        action: The last action, ``N x action_dim`` or one for all rows; None at the start.
        margins: Margins of the constraints in the steps ahead, ``T x c``, the last one for all
            beyond; see :func:`~gpadjust.control.constraints.margins`. Default: none.
    """

    steps_done: Any = 0
    action: Tensor | None = None
    margins: Tensor | None = None

    def after(self, actions: Tensor) -> Moment:
        """Return the moment after a step with these actions."""
        margins = self.margins
        if margins is not None and len(margins) > 1:
            margins = margins[1:]
        return Moment(self.steps_done + 1, actions, margins)


class Steps(NamedTuple):
    """Steps in a model: ``N`` of them, or ``k x n x T``, of ``n`` episodes in ``k`` functions.

    Args:
        states: The states at which actions were taken, ``... x state_dim``.
        actions: As near to the chosen ones as the action rate allows, ``... x action_dim``.
        next_states: ``... x state_dim``; the old state where the step left the bounds.
        rewards: ``...``, as all that follow; where it left the bounds, the reward of staying.
        made: Whether the step was made: not where it left the bounds, nor after the end of an
            episode, where all other entries mean nothing.
        terminated: Whether the next state ends the episode.
        left_bounds: Whether it would have left the bounds or the finite numbers, or the physics
            failed.
        overshoot: How far it would have left the bounds, in halves of their width, summed over the
            states; with its gradient, which leads back. 0 where that is not finite.
        violation: Violation of the constraints with their margins, in sum; 0 if they hold.
        price: What the change of the action costs.
    """

    states: Tensor
    actions: Tensor
    next_states: Tensor
    rewards: Tensor
    made: Tensor
    terminated: Tensor
    left_bounds: Tensor
    overshoot: Tensor
    violation: Tensor
    price: Tensor


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
            the starts of real episodes.
        episode_length: Steps after which an episode is truncated, in the model and by an
            :class:`Agent`. Default: the time limit of the environment.
        state_bounds: Lower and upper bounds of the states, ``2 x state_dim``, beyond which the
            model is not followed; infinite where there is none. Default: far beyond the recorded
            states of an agent that has some; else none.
        sensors: What is measured of the states, which observations then are; it takes
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
        ValueError: If a number or the bounds are out of range, or parts contradict each other.

    Example:
        >>> import torch
        >>> from gpadjust.control import Task
        >>> from gpadjust.dynamics import LearnedDynamics, StateSpec
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
        """Check what can be checked without a state."""
        check_kind("dynamics", self.dynamics, Dynamics, "an object of a Dynamics")
        check_kind("sensors", self.sensors, Sensors | None, 'Sensors(["x", "theta"]), say')
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
        spec = self.dynamics.spec
        if self.state_bounds is not None:
            bounds = checked_bounds("state_bounds", self.state_bounds, spec.state_dim, finite=False)
            object.__setattr__(self, "state_bounds", bounds)
        self.observed  # noqa: B018 - or an error on the names of the sensors
        limits = [] if self.rate is None else self.rate.limits
        moves, hidden = self.reference is not None, self.sensors is not None
        for is_wrong, message in (
            (
                moves and not spec.exogenous,
                "reference says the values of exogenous states, but the spec has none; name the "
                "set-points among `exogenous`, and let the environment observe them.",
            ),
            (
                hidden and self.initial_states is None,
                "Of hidden states it must be known where episodes start; pass initial_states, or "
                "start of a System, as well as sensors.",
            ),
            (
                hidden and moves,
                "The estimate of hidden states takes set-points for constant; leave reference out, "
                "or the sensors.",
            ),
            (
                len(limits) not in (0, 1, spec.action_dim),
                f"action_rate must have one limit, or one for each of {spec.action_dim} actions; "
                f"found {len(limits)}.",
            ),
        ):
            if is_wrong:
                raise ValueError(message)

    @property
    def observed(self) -> StateSpec:
        """The spec of observations: of the states, or of the outputs of the sensors."""
        spec = self.dynamics.spec
        return spec if self.sensors is None else self.sensors.spec(spec)

    @property
    def rate(self) -> ActionRate | None:
        """``action_rate`` as an object, None if there is none."""
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
        """Take actions ``N x action_dim`` at states ``N x state_dim`` of the model.

        This is the one place where action rate, set-points, bounds and constraints act.

        Args:
            states: The states.
            actions: The actions that are chosen there.
            moment: The point of the episode. Default: its beginning.
            move: Next states of these. Default: drawn from the dynamics, row by row.
            some_must_succeed: Whether it is an error that the physics fails for all rows.

        Raises:
            PhysicsError: If the physics fails everywhere, or does not say where.
        """
        moment = Moment() if moment is None else moment
        none = torch.zeros(len(states), dtype=torch.float64)
        price = violation = none
        if self.rate is not None and moment.action is not None:
            actions = self.rate.limited(actions, moment.action)
            price = self.rate.price * (actions - moment.action).square().sum(-1)
        move = self.dynamics.sample if move is None else move
        following = step_or_nan(move, states, actions, some_must_succeed=some_must_succeed)
        set_points = self.set_points(states, moment.steps_done + 1)
        if set_points is not None:
            following = following.clone()
            following[:, self.dynamics.spec.exogenous_columns] = set_points
        left, overshoot = self._left_bounds(following)
        if left.any():
            following = torch.where(left.unsqueeze(-1), states, following)
        rewards = self.rewards(states, actions, following)
        terminated = none.bool()
        if self.terminated is not None:
            terminated = self.terminations(following) & ~left
        if self.constraints is not None:
            values = self.constraint_values(following, actions)
            if moment.margins is not None:
                values = values + moment.margins[0]
            violation = values.clamp_min(0.0).sum(-1)
        ends = (~left, terminated, left, overshoot)
        return Steps(states, actions, following, rewards, *ends, violation, price)

    def _left_bounds(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return which of ``N`` states are beyond the bounds or not finite, and how far beyond."""
        left, overshoot = ~states.isfinite().all(-1), states.new_zeros(len(states))
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
        """Return this task, or one whose bounds give way to ``N x state_dim`` beyond them."""
        if self.state_bounds is None:
            return self
        low, high = self.state_bounds
        span = torch.where((high - low).isfinite(), high - low, 0.0)
        slack = 1e-5 * span  # observations have single precision
        wider = ((states < low - slack) | (states > high + slack)).any(0)
        if not wider.any():
            return self
        low = torch.where(wider, torch.minimum(low, states.amin(0) - span / 2), low)
        high = torch.where(wider, torch.maximum(high, states.amax(0) + span / 2), high)
        return replace(self, state_bounds=torch.stack([low, high]))

    # The user's functions, checked

    def draw_initial_states(self, n: int) -> Tensor:
        """Draw ``n x state_dim`` states at which episodes start; a ValueError if nothing does."""
        if self.initial_states is None:
            raise ValueError("The task does not say where episodes start; pass initial_states.")
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
        """Return the exogenous states after steps of these numbers, from 1, at ``N`` states.

        They are ``N x len(spec.exogenous)``; None without a ``reference``, as they stay.
        """
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
        self.step(states, actions, move=lambda states, actions: states)
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
                    f"The spec of the {whose} says that the {name} has {size} entries (an angle is "
                    f"seen as sine and cosine), so a Box of shape ({size},) is expected; found "
                    f"{space}. {spec}."
                )
        if not np.isfinite([action_space.low, action_space.high]).all():
            raise ValueError(
                "Actions must have bounds, between which plans and policies choose; found "
                f"{action_space}. Set env.action_space = gymnasium.spaces.Box(low, high) with "
                "the bounds of the machine."
            )

    def refuse(self, learner: str, name: str, way_out: str) -> None:
        """Raise a ValueError if the task has the part ``name``, with which a learner cannot do."""
        if getattr(self, name) is not None:
            raise ValueError(f"{learner} cannot learn a task with {name}; {way_out}.")

    def describe(self) -> dict[str, Any]:
        """Return the task in plain values: of functions, whether there is one."""
        bounds, sensors, rate = self.state_bounds, self.sensors, self.action_rate
        return {
            **{f"dynamics.{name}": text for name, text in self.dynamics.describe().items()},
            **{name: getattr(self, name) is not None for name in _FUNCTIONS if name != "reward"},
            "episode_length": self.episode_length,
            "state_bounds": None if bounds is None else bounds.tolist(),
            "sensors": None if sensors is None else sensors.describe(),
            "probability": self.probability,
            "action_rate": None if rate is None else repr(rate),
        }


def checked_values(function: str, values: Any, *shape: int | str) -> Tensor:
    """Return values of a user's function as a tensor; a letter is any number of columns.

    Raises:
        ValueError: If they have another shape, or are not finite.
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
    """Return whether something is a function that takes so many arguments."""
    try:
        inspect.signature(function).bind(*range(num_arguments))
    except TypeError:
        return False
    except ValueError:  # some compiled functions have no signature
        pass
    return True
