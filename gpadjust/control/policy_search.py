"""Policies, and their search by gradients through a model."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import KW_ONLY, dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from gpadjust.checks import checked_bounds, checked_number, checked_whole
from gpadjust.control.rollouts import Objective, Return, Rollouts, check_objective
from gpadjust.control.task import Task
from gpadjust.progress import tick
from gpadjust.states import StateSpec

_GENTLE = 0.1  # factor of the last weights at the start
_REDRAW_EVERY = 5  # updates between two tests of the policy, and between draws of functions
_MAX_GRAD_NORM = 1.0


class BoundedPolicy(nn.Module):
    r"""A network whose actions are within bounds.

    .. math:: a = \frac{h + l}{2} + \frac{h - l}{2} \tanh(\pi(z)), \quad z = (o - m) / s,

    where o is the observation (:meth:`~gpadjust.states.StateSpec.observe`) and :math:`\pi` the
    ``body``, layers of float64, which you may replace by another module.

    Args:
        spec: The names of states and actions.
        action_bounds: Lower and upper bounds l and h of the actions, ``2 x action_dim``.
        net_arch: The widths of the hidden layers; () for a linear function.

    Example:
        >>> policy = BoundedPolicy(StateSpec(["x"], ["force"]), [[-2.0], [2.0]])
        >>> policy(torch.zeros(3, 1, dtype=torch.float64)).shape
        torch.Size([3, 1])
    """

    action_bounds: Tensor
    origin: Tensor
    unit: Tensor

    def __init__(
        self, spec: StateSpec, action_bounds: ArrayLike, net_arch: Sequence[int] = (64, 64)
    ) -> None:
        super().__init__()
        bounds = checked_bounds("action_bounds", action_bounds, spec.action_dim)
        self.spec = spec
        self.register_buffer("action_bounds", bounds)
        self.register_buffer("origin", torch.zeros(spec.observation_dim, dtype=torch.float64))
        self.register_buffer("unit", torch.ones(spec.observation_dim, dtype=torch.float64))
        layers: list[nn.Module] = []
        for widths in pairwise([spec.observation_dim, *net_arch, spec.action_dim]):
            layers += [nn.Linear(*widths, dtype=torch.float64), nn.Tanh()]
        self.body = nn.Sequential(*layers[:-1])
        last: Any = self.body[-1]
        with torch.no_grad():
            last.weight.mul_(_GENTLE)
            last.bias.zero_()  # the middle of the bounds

    def forward(self, states: Tensor) -> Tensor:
        """Return actions ``N x action_dim`` at states ``N x state_dim``."""
        return self.act(self.spec.observe(states))

    def act(self, observations: Tensor) -> Tensor:
        """Return actions ``N x action_dim`` at observations ``N x observation_dim``."""
        low, high = self.action_bounds
        raw = self.body((observations - self.origin) / self.unit)
        return (low + high) / 2 + (high - low) / 2 * raw.tanh()

    def look_at(self, states: Tensor) -> None:
        """Take the scale of observations from states ``N x state_dim``; once, before training."""
        observations = self.spec.observe(states)
        self.origin.copy_(observations.mean(0))
        spread = observations.std(0, correction=0)
        self.unit.copy_(torch.where(spread > 1e-6 * observations.abs().amax(0), spread, 1.0))


class SearchResult(NamedTuple):
    """Result of a search."""

    values: Tensor  #: of the objective in each update, for drawn functions and starts
    reward: float  #: mean reward of a step of the best policy, in held-out functions and starts
    left_bounds: float  #: share of the held-out episodes that left the bounds
    seconds: float


@dataclass(frozen=True)
class PolicySearch:
    """Improves a policy along episodes in the mean of the dynamics, or in functions drawn from it.

    Each update follows the gradient of the objective back through all steps, through policy, f_p
    and its correction (Deisenroth and Rasmussen 2011; Parmas et al. 2018; Amadio et al. 2022); a
    black box as physics has finite differences. Every few updates the functions are drawn again,
    and the policy is tested with held-out functions and starts. The result is the best policy of
    these tests, possibly the first.

    Args:
        objective: The goal. Default: the mean return; ``Return(quantile=0.2)`` is careful.
        updates: Number of gradient steps (Adam).
        num_starts: Number of starts of each update.
        num_functions: Number of functions for each start, such as 6; after one or two real episodes
            they may differ too much for one policy. None for the mean.
        learning_rate: Learning rate at the start; it decays to a tenth along a cosine.

    Raises:
        TypeError: If an argument has another type.
        ValueError: If a number is out of range.

    Example:
        >>> import torch
        >>> from gpadjust.control import BoundedPolicy, PolicySearch, Task
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> spec = StateSpec(["x"], ["v"])
        >>> task = Task(
        ...     PhysicsDynamics(spec, lambda X: X[:, :1] + 0.5 * X[:, 1:]),
        ...     lambda states, actions, next_states: -next_states[:, 0].square(),
        ...     initial_states=lambda n: torch.randn(n, 1, dtype=torch.float64),
        ...     episode_length=5,
        ... )
        >>> policy = BoundedPolicy(spec, [[-1.0], [1.0]], net_arch=())
        >>> PolicySearch(updates=30, learning_rate=0.1).improve(policy, task).values.shape
        torch.Size([30])
    """

    objective: Objective = field(default_factory=Return)
    _: KW_ONLY
    updates: int = 100
    num_starts: int = 24
    num_functions: int | None = None
    learning_rate: float = 3e-3

    def __post_init__(self) -> None:
        """Check the options."""
        check_objective(self.objective, self.num_functions)
        checked_whole("updates", self.updates, 1)
        checked_whole("num_starts", self.num_starts, 1)
        checked_number("learning_rate", self.learning_rate, above=0)

    def check_task(self, task: Task) -> None:
        """Raise a ValueError if a task has limits that a policy cannot keep."""
        for part in ("constraints", "action_rate"):
            task.refuse(type(self).__name__, part, "MPCAgent can")

    def improve(self, policy: nn.Module, task: Task) -> SearchResult:
        """Improve a policy, from states ``N x state_dim`` to actions ``N x action_dim``.

        The randomness is PyTorch's global generator. An error leaves the policy as it was.

        Raises:
            TypeError: If the policy is not a module with parameters.
            ValueError: If the task lacks a part.
            RuntimeError: If the dynamics are not fitted, or no gradient flows to the policy.
            PhysicsError: If the physics fails at all starts.
        """
        if not isinstance(policy, nn.Module) or not [*policy.parameters()]:
            raise TypeError(
                f"policy must be a module with parameters, such as BoundedPolicy(...); found "
                f"{policy!r}."
            )
        self.check_task(task)
        if task.episode_length is None:
            raise ValueError("A policy search needs a task with episode_length; found None.")
        begun = time.perf_counter()
        values: list[Tensor] = []
        length = task.episode_length
        home = next(policy.parameters()).device
        policy.to("cpu")  # the device of the dynamics
        result = best = deepcopy(policy.state_dict())
        best_worth = -math.inf
        parameters = [p for p in policy.parameters() if p.requires_grad]
        optimizer = torch.optim.Adam(parameters, lr=self.learning_rate)
        rate = torch.optim.lr_scheduler.CosineAnnealingLR(
            optimizer, self.updates, eta_min=self.learning_rate / 10
        )
        try:
            compute_score = self.objective.make_score(task)
            held_out = Rollouts(task, self.num_functions)
            starts = task.draw_initial_states(self.num_starts)
            for i in range(self.updates + 1):
                # Test the policy.
                if i % _REDRAW_EVERY == 0 or i == self.updates:
                    with torch.no_grad():
                        test = held_out.act(starts, policy, length)
                        worth = float(compute_score(test).mean())
                    if i == 0 or worth > best_worth:
                        best = deepcopy(policy.state_dict())
                        best_worth = worth
                        reward = float(test.rewards[test.made].mean())
                        left = float(test.left_bounds.any(-1).double().mean())
                if i == self.updates:
                    break
                if i % _REDRAW_EVERY == 0:
                    rollouts = Rollouts(task, self.num_functions)
                # Follow the gradient of the objective, per step.
                drawn = task.draw_initial_states(self.num_starts)
                value = compute_score(rollouts.act(drawn, policy, length)).mean() / length
                if not value.requires_grad:
                    raise RuntimeError(
                        "No gradient flows from the rewards to the policy. Write the reward in "
                        "torch, without .detach() and .numpy()."
                    )
                optimizer.zero_grad()
                (-value).backward()
                if nn.utils.clip_grad_norm_(parameters, _MAX_GRAD_NORM).isfinite():
                    optimizer.step()
                rate.step()
                values.append(value.detach())
                tick("updates")
            result = best
        finally:
            policy.load_state_dict(result)
            policy.to(home)
        return SearchResult(torch.stack(values), reward, left, time.perf_counter() - begun)
