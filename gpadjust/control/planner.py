"""Plans of actions by the cross-entropy method."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from gpadjust.checks import checked_bounds, checked_number, checked_whole
from gpadjust.control.constraints import margins
from gpadjust.control.rollouts import (
    Objective,
    Return,
    Rollouts,
    check_objective,
    random_sequences,
)
from gpadjust.control.state_filter import Estimate
from gpadjust.control.task import Moment, Steps, Task
from gpadjust.progress import tick
from gpadjust.states import StateSpec


class Plan(NamedTuple):
    """Actions for the steps ahead of an episode, with values averaged over the functions."""

    actions: Tensor  #: T x action_dim
    next_states: Tensor  #: T x state_dim
    value: float  #: score of the objective
    rewards: Tensor  #: of the steps, T; 0 after the end of the episode
    reward: float  #: their mean over the steps that are made, at the last plan to the end
    left_bounds: float  #: share of the functions that leave the bounds, or where the physics fails
    violation: float  #: of the constraints with their margins in the worst step; 0 if none
    moment: Moment  #: the point of the episode before the first step
    promised: Tensor = torch.zeros(0)  #: rewards of all steps, by the last plan to the end
    estimate: Estimate | None = None  #: the state by sensors, with the action there

    @classmethod
    def select(cls, rollout: Steps, n: int, value: float, moment: Moment) -> Plan:
        """Return the actions of the n-th episodes of a rollout as a plan."""
        made = rollout.made[:, n]
        rewards = rollout.rewards[:, n].masked_fill(~made, 0.0).mean(0)
        return cls(
            actions=rollout.actions[0, n],
            next_states=rollout.next_states[:, n].mean(0),
            value=value,
            rewards=rewards,
            reward=float(rewards.sum() / made.double().mean(0).sum().clamp_min(1e-12)),
            left_bounds=float(rollout.left_bounds[:, n].any(-1).double().mean()),
            violation=float(rollout.violation[:, n].mean(0).max()),
            moment=moment,
        )

    def after(self, num_steps: int, estimate: Estimate | None = None) -> Plan:
        """Return the rest of the plan after its first actions."""
        moment = self.moment
        for action in self.actions[:num_steps]:
            moment = moment.after(action)
        return self._replace(
            actions=self.actions[num_steps:],
            next_states=self.next_states[num_steps:],
            moment=moment,
            estimate=estimate and estimate._replace(action=moment.action),
        )


@dataclass(frozen=True)
class Planner:
    """Plans actions by an objective, such as the return, in a model of the system.

    The cross-entropy method (Rubinstein 1999): sequences of actions, random ones or variations of
    an earlier plan, are followed through the mean of the model or functions drawn from it. Each
    round draws as many from a normal distribution with mean and standard deviation of the best.

    Args:
        objective: The goal: :class:`Return`, or your own.
        rounds: Rounds after the first sequences; 0 takes the best of these.
        num_elites: Number of best sequences that stay in a round.
        correlation: Correlation of the deviations of successive steps, in [0, 1): higher for
            smoother actions (Pinneri et al. 2020).
        horizon: Time to look ahead, in the time unit of ``spec.step``; in steps where the spec has
            none. Default: to the end of the episode; of a step's plan in :class:`MPC` a third of
            the episode, 8 to 30 steps.
        num_functions: Number of functions drawn from the model; None for its mean, the fastest.
        num_random: Number of sequences of a round.
        max_hold: Largest number of steps that a random sequence holds an action.
        spread: Standard deviation about an earlier plan, as a share of the range of the actions.
        seconds: Time limit of a plan: fewer rounds, or a shorter look ahead. Default: none.

    Raises:
        TypeError: If the objective or a number has another type.
        ValueError: If a number is out of range.

    Example:
        >>> from gpadjust.dynamics import PhysicsDynamics
        >>> point = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + X[:, 1:])
        >>> task = Task(point, lambda states, actions, next_states: -next_states[:, 0].abs())
        >>> plan = Planner().plan(task, torch.ones(1).double(), [[-1.0], [1.0]], num_steps=3)
        >>> plan.actions.shape, plan.value > -1
        (torch.Size([3, 1]), True)
    """

    objective: Objective = field(default_factory=Return)
    _: KW_ONLY
    rounds: int = 1
    num_elites: int = 12
    correlation: float = 0.5
    horizon: float | None = None
    num_functions: int | None = None
    num_random: int = 128
    max_hold: int = 5
    spread: float = 0.15
    seconds: float | None = None

    def __post_init__(self) -> None:
        """Check objective and numbers."""
        check_objective(self.objective, self.num_functions)
        for name, least in {"rounds": 0, "num_elites": 1, "num_random": 1, "max_hold": 1}.items():
            checked_whole(name, getattr(self, name), least)
        for name in ("horizon", "seconds"):
            if getattr(self, name) is not None:
                checked_number(name, getattr(self, name), above=0)
        checked_number("correlation", self.correlation, least=0, below=1)
        checked_number("spread", self.spread, above=0, below=1)

    def steps_ahead(self, spec: StateSpec, left: int | None) -> int:
        """Return the number of steps to plan, of the steps left; a ValueError without any."""
        limits = [] if left is None else [left]
        if self.horizon is not None:
            step = spec.step or 1.0
            limits.append(round(self.horizon / step))
            if self.horizon < step * (1 - 1e-9):
                raise ValueError(
                    f"horizon must be one step at least, which takes {step:g} in the time unit of "
                    f"StateSpec(step=...); found {self.horizon:g}."
                )
        if not limits or min(limits) < 1:
            raise ValueError(
                f"Expected a number of steps >= 1 to plan, found {left}; give the task an "
                "episode_length, or the planner a horizon."
            )
        return min(limits)

    @torch.no_grad()
    def plan(
        self,
        task: Task,
        state: Tensor,
        action_bounds: ArrayLike,
        num_steps: int | None = None,
        *,
        earlier: Plan | None = None,
        moment: Moment | None = None,
        covariance: Tensor | None = None,
        deadline: float | None = None,
    ) -> Plan:
        """Choose the actions of the next steps; the randomness is PyTorch's global generator.

        Constraints have margins along the earlier plan, or along a first plan without margins.

        Args:
            task: The task, with fitted dynamics.
            state: The present state, ``state_dim``.
            action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
            num_steps: Number of steps before the end. Default: the episode length of the task.
            earlier: A plan to begin with; its last action is held where it is shorter.
            moment: The point of the episode. Default: its beginning.
            covariance: Covariance of the state, ``state_dim x state_dim``. Default: zero.
            deadline: Time limit by ``time.perf_counter``. Default: after ``seconds``.

        Raises:
            ValueError: If ``state`` or ``action_bounds`` have another shape, bounds are not finite,
                or there is no number of steps.
            RuntimeError: If the dynamics are not fitted.
            PhysicsError: If the physics fails at ``state``, whatever the action.
        """
        if deadline is None:
            deadline = time.perf_counter() + (self.seconds or math.inf)
        moment = moment or Moment()
        spec = task.dynamics.spec
        bounds = checked_bounds("action_bounds", action_bounds, spec.action_dim)
        if state.shape != (spec.state_dim,):
            raise ValueError(
                f"Expected state of shape {spec.state_dim}, found {tuple(state.shape)}."
            )
        num_steps = self.steps_ahead(spec, task.episode_length if num_steps is None else num_steps)

        def search(moment: Moment, earlier: Plan | None) -> Plan:
            rollouts = Rollouts(task, self.num_functions, moment, deadline=deadline)
            return self._search(rollouts, state, bounds, self._propose(num_steps, bounds, earlier))

        if task.constraints is not None:
            earlier = earlier or search(moment, None)
            actions = earlier.actions[:num_steps]
            path = torch.cat([state.unsqueeze(0), earlier.next_states])[: len(actions)]
            moment = moment._replace(margins=margins(task, path, actions, bounds, covariance))
        return search(moment, earlier)

    def _search(self, rollouts: Rollouts, state: Tensor, bounds: Tensor, new: Tensor) -> Plan:
        """Return the best plan that the cross-entropy method finds from first sequences."""
        compute_score = self.objective.make_score(rollouts.task)
        num_steps = new.shape[1]
        rollout = rollouts.follow(state, new)
        sequences = new
        scores = self._checked(compute_score(rollout), len(new))
        best = int(scores.argmax())
        plan = Plan.select(rollout, best, float(scores[best]), rollouts.moment)
        tick("rounds")
        for _ in range(self.rounds):
            if not rollouts.has_time(num_steps):
                break
            # The best sequences, and as many new ones from their mean and standard deviation.
            elites = scores.topk(min(self.num_elites, len(scores))).indices
            sequences = sequences[elites]
            scores = scores[elites]
            noise = _correlated_noise(new.shape, self.correlation)
            drawn = sequences.mean(0) + sequences.std(0, correction=0) * noise
            new = torch.clamp(drawn, bounds[0], bounds[1])
            rollout = rollouts.follow(state, new)
            tick("rounds")
            if rollout.made.shape[-1] < num_steps:  # no time left
                break
            new_scores = self._checked(compute_score(rollout), len(new))
            best = int(new_scores.argmax())
            if new_scores[best] > plan.value:
                plan = Plan.select(rollout, best, float(new_scores[best]), rollouts.moment)
            sequences = torch.cat([sequences, new])
            scores = torch.cat([scores, new_scores])
        return plan

    def _checked(self, scores: Tensor, number: int) -> Tensor:
        """Return the scores of an objective; raise a ValueError unless there is one a sequence."""
        if scores.shape != (number,) or scores.isnan().any():
            raise ValueError(
                f"{type(self.objective).__name__} must return one score per sequence, shape "
                f"({number},), none of them nan; found shape {tuple(scores.shape)}."
            )
        return scores

    def _propose(self, num_steps: int, bounds: Tensor, earlier: Plan | None) -> Tensor:
        """Draw the first sequences of a search, ``n x num_steps x action_dim``."""
        if earlier is None:
            return random_sequences(self.num_random, num_steps, bounds, self.max_hold)
        # The earlier plan, its last action held, and variations of it.
        rows = torch.arange(num_steps).clamp_max(len(earlier.actions) - 1)
        actions = earlier.actions[rows]
        noise = _correlated_noise((self.num_random, *actions.shape), 0.5)
        drawn = actions + self.spread * (bounds[1] - bounds[0]) * noise
        return torch.cat([actions.unsqueeze(0), torch.clamp(drawn, bounds[0], bounds[1])])


def _correlated_noise(shape: Sequence[int], correlation: float) -> Tensor:
    """Draw standard normal noise ``n x T x a`` with correlated steps."""
    noise = torch.randn(*shape, dtype=torch.float64)
    if correlation:
        # e_t = rho e_{t-1} + sqrt(1 - rho^2) n_t has variance 1
        fresh = math.sqrt(1 - correlation**2)
        for t in range(1, shape[1]):
            noise[:, t] = correlation * noise[:, t - 1] + fresh * noise[:, t]
    return noise
