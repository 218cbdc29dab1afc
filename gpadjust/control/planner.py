"""Sequences of actions that are searched for in a model."""

from __future__ import annotations

import math
import time
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from gpadjust.checks import check_kind, checked_bounds, checked_number, checked_whole
from gpadjust.control.rollouts import Objective, Return, Rollout, Rollouts
from gpadjust.control.search import CrossEntropy, correlated_noise, random_sequences
from gpadjust.control.task import Task
from gpadjust.states import StateSpec


class Plan(NamedTuple):
    """Actions for an episode, or for the rest of it.

    Args:
        actions: ``T x action_dim``.
        value: What the objective says of it.
        rewards: What the model says of each step, ``T``, averaged over its functions; 0 after the
            end of the episode.
        left_bounds: The share of the functions in which it leaves the bounds of the states, or
            meets a failure of the physics.
        made: The share of the functions in which each step is made, ``T``: 0 after the end.
        next_states: The states that it comes to, ``T x state_dim``, averaged over the functions.
        violation: How far constraints with their margins are violated in the worst step; 0 if none.
    """

    actions: Tensor
    value: float
    rewards: Tensor
    left_bounds: float
    made: Tensor
    next_states: Tensor
    violation: float = 0.0

    @classmethod
    def of(cls, rollout: Rollout, n: int, value: float) -> Plan:
        """The plan of the actions that were taken in the n-th episodes of a rollout."""
        made = rollout.made[:, n]
        return cls(
            rollout.actions[0, n],
            value,
            rollout.rewards[:, n].masked_fill(~made, 0.0).mean(0),
            float(rollout.left_bounds[:, n].double().mean()),
            made.double().mean(0),
            rollout.next_states[:, n].mean(0),
            float(rollout.violation[:, n].mean(0).max()),
        )


@dataclass(frozen=True)
class Planner:
    """Plans actions by an objective, such as the return, in a model of the system.

    Sequences of actions are proposed; each is followed through the model, along its mean or
    through functions drawn from its posterior; and a search improves them. At first they are random
    piecewise constant ones; where there is an earlier plan, they are drawn about it. :class:`MPC`
    plans again at every step.

    Args:
        objective: What to look for: :class:`Return`, or your own.
        search: How the sequences are improved.
        horizon: The most time to look ahead, in the time unit of ``spec.step``; in steps where the
            spec has none. Default: to the end of the episode.
        num_functions: How many functions of the posterior each sequence is followed through; None
            for the mean of the model alone, which takes least time. (Of a sampled model it is the
            mean of some samples, two or more, see
            :meth:`~gpadjust.dynamics.LearnedDynamics.mean_function`.)
        num_random: Number of random sequences, or of those drawn about an earlier plan.
        max_hold: The most steps that a random sequence holds an action.
        spread: Standard deviation of what is drawn about an earlier plan, as a share of the range
            of the actions.
        seconds: The most time that a plan takes. A round of the search that would take longer does
            not begin; if even the first one would, its sequences are followed, and compared, as far
            as there is time, one step of the model at least. Default: as long as it takes.
        segment: Without an earlier plan, one more search begins with a plan in segments of this
            duration (in the unit of ``horizon``): half of a segment is made in the model, where the
            next one is planned. Of an unstable system, random sequences of a whole episode tell
            nothing. Default: none.

    Raises:
        TypeError: If objective or search is none, or a number is of another kind.
        ValueError: If a number is out of range, or there is nothing to choose from.

    Example:
        >>> import torch
        >>> from gpadjust.control import Planner, Return, Task
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> point = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + X[:, 1:])
        >>> task = Task(point, lambda states, actions, next_states: -next_states[:, 0].abs())
        >>> bounds = torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
        >>> plan = Planner(Return()).plan(task, torch.ones(1).double(), bounds, 3)
        >>> plan.actions.shape, plan.value > -1
        (torch.Size([3, 1]), True)
    """

    objective: Objective = field(default_factory=Return)
    search: CrossEntropy = field(default_factory=CrossEntropy)
    _: KW_ONLY
    horizon: float | None = None
    num_functions: int | None = None
    num_random: int = 80
    max_hold: int = 5
    spread: float = 0.1
    seconds: float | None = None
    segment: float | None = None

    def __post_init__(self) -> None:
        """Check objective, search and numbers."""
        told = "an object of an Objective, such as Return()"
        check_kind("objective", self.objective, Objective, told)
        check_kind("search", self.search, CrossEntropy, "a CrossEntropy(...)")
        for name in ("num_random", "max_hold"):
            checked_whole(name, getattr(self, name), 1)
        if self.num_functions is not None:
            checked_whole("num_functions", self.num_functions, 1)
        for name in ("horizon", "seconds", "segment"):
            if getattr(self, name) is not None:
                checked_number(name, getattr(self, name), above=0)
        self.objective.check_functions(self.num_functions)
        checked_number("spread", self.spread, above=0, below=1)
        if None not in (self.seconds, self.segment):
            raise ValueError("A plan in segments has no time limit; leave out seconds or segment.")

    def steps_ahead(self, spec: StateSpec) -> int | None:
        """Return the horizon in steps; None to the end of the episode.

        Raises:
            ValueError: If it is shorter than a step.
        """
        return in_steps("horizon", self.horizon, spec)

    @torch.no_grad()
    def plan(
        self,
        task: Task,
        state: Tensor,
        action_bounds: ArrayLike,
        num_steps: int | None = None,
        *,
        known: Tensor | None = None,
        steps_done: int = 0,
        before: Tensor | None = None,
        margins: Tensor | None = None,
    ) -> Plan:
        """Choose the actions of the next steps; the randomness is PyTorch's global generator.

        Args:
            task: The task, whose dynamics have learnt from transitions. Steps beyond its bounds are
                not made.
            state: Where the episode is, ``state_dim``.
            action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``, finite.
            num_steps: How many steps are ahead; the plan is of these or of the horizon, ``T``.
                Default: the episode length of the task.
            known: An earlier plan, ``t x action_dim``; its last action is held where it is shorter.
            steps_done: How many steps the episode has made by then.
            before: The last action that was made, from which the next one may differ by the task's
                ``action_rate`` alone. Default: none, where an episode begins.
            margins: Those of the constraints, ``T x c``; see
                :func:`~gpadjust.control.constraints.margins`. Default: they hold in the mean.

        Raises:
            ValueError: If ``state`` or ``action_bounds`` have another shape, bounds are not finite,
                or nobody says how many steps there are.
            RuntimeError: If the dynamics have learnt nothing yet.
            PhysicsError: If the physics fails at ``state``, whatever the action.
        """
        deadline = math.inf if self.seconds is None else time.perf_counter() + self.seconds
        spec = task.dynamics.spec
        action_bounds = checked_bounds("action_bounds", action_bounds, spec.action_dim)
        num_steps = self._checked_steps(task, state, num_steps)
        score = self.objective.of(task)
        given: dict[str, Any] = {"margins": margins, "before": before, "deadline": deadline}
        rollouts = Rollouts(task, self.num_functions, **given)
        best: list[Plan] = []  # so far, the newest last

        def scored(sequences: Tensor) -> Tensor:
            if best and not rollouts.has_time(num_steps):
                raise _TimeIsUp
            rollout = rollouts.follow(state, sequences, steps_done)
            if best and rollout.made.shape[-1] < num_steps:
                raise _TimeIsUp
            scores = self._checked_scores(score(rollout), len(sequences))
            found = int(scores.argmax())
            if not best or scores[found] > best[-1].value:
                best.append(Plan.of(rollout, found, float(scores[found])))
            return scores

        def search(known: Tensor | None) -> None:
            first = self._proposed(num_steps, action_bounds, known)
            self.search.best(scored, first, action_bounds)

        known = None if known is None or not len(known) else known
        segment = in_steps("segment", self.segment, spec)
        with suppress(_TimeIsUp):
            search(known)
            if known is None and segment is not None and segment < num_steps:
                where = task, state, action_bounds, num_steps
                search(self._in_segments(*where, before, steps_done))
        return best[-1]

    def _in_segments(
        self,
        task: Task,
        state: Tensor,
        action_bounds: Tensor,
        num_steps: int,
        before: Tensor | None,
        steps_done: int,
    ) -> Tensor:
        """Actions ``num_steps x action_dim`` of segments, each begun in the middle of the last."""
        ahead = replace(self, horizon=self.segment, segment=None)
        actions, known = action_bounds[:0], None
        while (left := num_steps - len(actions)) > 0:
            done = steps_done + len(actions)
            how: dict[str, Any] = {"known": known, "before": before, "steps_done": done}
            plan = ahead.plan(task, state, action_bounds, left, **how)
            k = left if len(plan.actions) == left else -(-len(plan.actions) // 2)
            actions, known = torch.cat([actions, plan.actions[:k]]), plan.actions[k:]
            state, before = plan.next_states[k - 1], plan.actions[k - 1]
        return actions

    def _proposed(self, num_steps: int, bounds: Tensor, known: Tensor | None) -> Tensor:
        """The sequences that a search begins with, ``n x num_steps x action_dim``."""
        if known is None:
            return random_sequences(self.num_random, num_steps, bounds, self.max_hold)
        if known.dim() != 2 or known.shape[-1] != bounds.shape[-1]:
            raise ValueError(
                f"Expected known of shape {num_steps} x {bounds.shape[-1]}, found "
                f"{tuple(known.shape)}."
            )
        known = known[torch.arange(num_steps).clamp_max(len(known) - 1)]
        noise = correlated_noise(torch.Size((self.num_random, *known.shape)), 0.5)
        drawn = known + self.spread * (bounds[1] - bounds[0]) * noise
        return torch.cat([known.unsqueeze(0), torch.clamp(drawn, bounds[0], bounds[1])])

    def _checked_scores(self, scores: Tensor, n: int) -> Tensor:
        """Return the scores of ``n`` sequences by the objective, which may be -inf."""
        if scores.shape != (n,) or scores.isnan().any():
            name = type(self.objective).__name__
            found = "nan" if scores.shape == (n,) else f"shape {tuple(scores.shape)}"
            raise ValueError(
                f"{name} must return one score per sequence, shape ({n},), none of them nan; found "
                f"{found}."
            )
        return scores

    def _checked_steps(self, task: Task, state: Tensor, num_steps: int | None) -> int:
        """Check the arguments, and return the number of steps to plan."""
        spec = task.dynamics.spec
        if state.shape != (spec.state_dim,):
            raise ValueError(
                f"Expected state of shape {spec.state_dim}, found {tuple(state.shape)}."
            )
        horizon = self.steps_ahead(spec)
        num_steps = task.episode_length if num_steps is None else num_steps
        num_steps = horizon if num_steps is None else num_steps
        if num_steps is None or num_steps < 1:
            raise ValueError(
                f"Expected num_steps as a number of steps >= 1, found {num_steps}; pass it, or "
                "give the task an episode_length, or the planner a horizon."
            )
        return num_steps if horizon is None else min(num_steps, horizon)


class _TimeIsUp(Exception):  # noqa: N818 - no error
    """Raised in a search whose next round would take too long."""


def in_steps(name: str, duration: float | None, spec: StateSpec) -> int | None:
    """Return the number of steps nearest to a duration in the time unit of the spec.

    Raises:
        ValueError: If it is shorter than a step.
    """
    if duration is None:
        return None
    step = spec.step or 1.0
    if duration < step * (1 - 1e-9):
        raise ValueError(
            f"{name} must be one step at least, which takes {step:g} in the time unit of "
            f"StateSpec(step=...); found {duration:g}."
        )
    return round(duration / step)
