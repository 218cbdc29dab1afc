"""Policies that are improved by gradients through a model."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import KW_ONLY, dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor, nn

from gpadjust.checks import check_kind, checked_number, checked_whole
from gpadjust.control.mpc import Planner
from gpadjust.control.policies import BoundedPolicy
from gpadjust.control.rollouts import Objective, Return, Rollout, Rollouts, Score
from gpadjust.control.task import Task

_REDRAW_EVERY = 5  # updates after which the policy is judged, and other functions are drawn
_MAX_GRAD_NORM = 1.0


class SearchResult(NamedTuple):
    """Result of a search.

    Args:
        values: What the objective said in each update, ``updates``; of drawn functions and starts.
        reward: The mean reward of a step of the policy that was kept, in the draws that were held
            out.
        left_bounds: The share of episodes that left the bounds there.
        seconds: How long it took.
    """

    values: Tensor
    reward: float
    left_bounds: float
    seconds: float


@dataclass(frozen=True)
class PolicySearch:
    """Improves a policy along whole episodes in the mean of the dynamics, or in functions.

    Each update lets the policy act from ``num_starts`` states, and follows the gradient of the
    objective back through all steps, through policy, f_p and what was learnt (Deisenroth and
    Rasmussen 2011; Parmas et al. 2018; Amadio et al. 2022). With ``num_functions`` it acts in as
    many functions, each of them deterministic and the same along an episode; new ones are drawn as
    the search goes on, so that the policy cannot lean on the errors of a few. After one or two real
    episodes they may differ too much for one policy. A black box as physics has the gradients of
    its finite differences.

    Every few updates the policy is judged from starts, and in functions, that no update sees, the
    same each time. The best one is kept, be it the one that the search began with.

    Where gradients do not find the task by themselves (a swing-up: at first no action of the policy
    matters), plans do: with a ``guide`` the policy first imitates plans of some episodes.

    Args:
        objective: What to look for. Default: the mean return; ``Return(quantile=0.2)`` is careful.
        updates: Gradient steps (Adam).
        num_starts: Number of starts of each update, in each function.
        num_functions: Number of functions that each is followed through, such as 6; None for the
            mean.
        learning_rate: At the start; it decays to a tenth along a cosine.
        guide: Plans the episodes that the policy imitates before it is improved.
        num_guides: How many.

    Raises:
        TypeError: If something is of another kind.
        ValueError: If a number is out of range.

    Example:
        >>> import torch
        >>> from gpadjust.control import PolicySearch, Task, mlp_policy
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> spec = StateSpec(["x"], ["v"])
        >>> task = Task(
        ...     PhysicsDynamics(spec, lambda X: X[:, :1] + 0.5 * X[:, 1:]),
        ...     lambda states, actions, next_states: -next_states[:, 0].square(),
        ...     initial_states=lambda n: torch.randn(n, 1, dtype=torch.float64),
        ...     episode_length=5,
        ... )
        >>> _ = torch.manual_seed(0)
        >>> policy = mlp_policy(spec, torch.tensor([[-1.0], [1.0]]), net_arch=())
        >>> result = PolicySearch(updates=30, learning_rate=0.1).improve(policy, task)
        >>> bool(result.values[-5:].mean() > result.values[:5].mean())
        True
    """

    objective: Objective = field(default_factory=Return)
    _: KW_ONLY
    updates: int = 100
    num_starts: int = 24
    num_functions: int | None = None
    learning_rate: float = 3e-3
    guide: Planner | None = None
    num_guides: int = 16

    def __post_init__(self) -> None:
        """Check the options."""
        told = "an object of an Objective, such as Return()"
        check_kind("objective", self.objective, Objective, told)
        for name in ("updates", "num_starts", "num_guides"):
            checked_whole(name, getattr(self, name), 1)
        if self.num_functions is not None:
            checked_whole("num_functions", self.num_functions, 1)
        self.objective.check_functions(self.num_functions)
        checked_number("learning_rate", self.learning_rate, above=0)
        check_kind("guide", self.guide, Planner | None, "a Planner, or None")

    def check_task(self, task: Task) -> None:
        """Raise a ValueError if a task has what a policy cannot keep."""
        for part in ("constraints", "action_rate"):
            task.refuse(type(self).__name__, part, "MPCAgent can")

    def improve(
        self,
        policy: Callable[[Tensor], Tensor],
        task: Task,
        *,
        guided: bool = True,
        progress: Callable[[int, float], None] | None = None,
    ) -> SearchResult:
        """Improve a policy; the randomness is PyTorch's global generator.

        Args:
            policy: A module from states ``N x state_dim`` to actions ``N x action_dim``, whose
                parameters are changed; after an error they are as before.
            task: The task, whose dynamics are fitted. It must say where episodes start and how
                long they are.
            guided: Whether the policy imitates the ``guide`` first, if there is one: not where a
                policy that has learnt is to go on.
            progress: Called after each update with its number and what the objective said.

        Raises:
            TypeError: If the policy is no module with parameters.
            ValueError: If the task leaves something open.
            RuntimeError: If the dynamics have learnt nothing yet, or no gradient flows from the
                rewards to the policy.
            PhysicsError: If the physics fails at all starts.
        """
        if not isinstance(policy, nn.Module) or not [*policy.parameters()]:
            raise TypeError(
                f"policy must be a module with parameters, such as mlp_policy(...); found "
                f"{policy!r}."
            )
        self.check_task(task)
        if task.episode_length is None:
            raise ValueError("A policy search needs a task with episode_length; found None.")
        home = next(policy.parameters()).device
        policy.to("cpu")  # where the dynamics are
        before = {name: t.detach().clone() for name, t in policy.state_dict().items()}
        try:
            if guided and self.guide is not None:
                if not isinstance(policy, BoundedPolicy):
                    raise TypeError(
                        "A guide plans within the bounds of the actions, which only a "
                        "BoundedPolicy says, such as mlp_policy(...); found "
                        f"{type(policy).__name__}."
                    )
                _imitate(policy, *self.plans(task, policy.action_bounds))
            return self._improve(policy, task, task.episode_length, progress)
        except BaseException:
            policy.load_state_dict(before)
            raise
        finally:
            policy.to(home)

    def plans(self, task: Task, action_bounds: Tensor) -> tuple[Tensor, Tensor]:
        """States ``N x state_dim`` and actions ``N x action_dim`` of episodes by the guide."""
        assert self.guide is not None, "asked before"
        rollouts, parts = Rollouts(task, None), []
        for start in task.draw_initial_states(self.num_guides):
            plan = self.guide.plan(task, start, action_bounds)
            with torch.no_grad():
                rollout = rollouts.follow(start, plan.actions.unsqueeze(0))
            parts.append([part[rollout.made] for part in (rollout.states, rollout.actions)])
        states, actions = (torch.cat(column) for column in zip(*parts, strict=True))
        return states, actions

    def _improve(
        self,
        policy: nn.Module,
        task: Task,
        length: int,
        progress: Callable[[int, float], None] | None,
    ) -> SearchResult:
        begun = time.perf_counter()
        parameters = [p for p in policy.parameters() if p.requires_grad]
        optimizer = torch.optim.Adam(parameters, lr=self.learning_rate)
        rate = torch.optim.lr_scheduler.CosineAnnealingLR(
            optimizer, self.updates, eta_min=self.learning_rate / 10
        )
        score = self.objective.of(task)
        held_out = Rollouts(task, self.num_functions)
        best = _Best(held_out, self._starts(task, held_out.num_functions), score, length)
        values = []
        for i in range(self.updates):
            if i % _REDRAW_EVERY == 0:
                best.judge(policy)
                rollouts = Rollouts(task, self.num_functions)
            rollout = rollouts.act(self._starts(task, rollouts.num_functions), policy, length)
            value = score(rollout).mean() / length
            if not value.requires_grad:
                raise RuntimeError(
                    "No gradient flows from the rewards to the policy: the task's reward or the "
                    "dynamics are computed without PyTorch's autograd. Write the reward in torch, "
                    "without .detach() and .numpy()."
                )
            optimizer.zero_grad()
            (-value).backward()
            norm = nn.utils.clip_grad_norm_(parameters, _MAX_GRAD_NORM)
            if norm.isfinite():
                optimizer.step()
            rate.step()
            values.append(value.detach())
            if progress is not None:
                progress(i + 1, float(value.detach()))
        best.judge(policy)
        policy.load_state_dict(best.kept)
        rewards, left = best.rollout.rewards[best.rollout.made], best.rollout.left_bounds
        seconds = time.perf_counter() - begun
        share = float(left.double().mean())
        return SearchResult(torch.stack(values), float(rewards.mean()), share, seconds)

    def _starts(self, task: Task, num_functions: int) -> Tensor:
        """Starts of an update: others in each function, unless these are compared at the same."""
        if self.objective.compares_functions:
            return task.draw_initial_states(self.num_starts)
        starts = task.draw_initial_states(num_functions * self.num_starts)
        return starts.unflatten(0, (num_functions, self.num_starts))


class _Best:
    """The best policy so far, by functions and starts that no update sees.

    Args:
        rollouts: In the functions.
        starts: As of :meth:`Rollouts.act`.
        score: The worth of a rollout.
        length: Steps of an episode.
    """

    kept: dict[str, Tensor]
    rollout: Rollout

    def __init__(self, rollouts: Rollouts, starts: Tensor, score: Score, length: int) -> None:
        self.rollouts, self.starts, self.score, self.length = rollouts, starts, score, length
        self.worth: float | None = None

    def judge(self, policy: nn.Module) -> None:
        """Keep a policy, if it is better than the one that is kept."""
        with torch.no_grad():
            rollout = self.rollouts.act(self.starts, policy, self.length)
            worth = float(self.score(rollout).mean())
        if self.worth is None or worth > self.worth:
            self.worth, self.rollout, self.kept = worth, rollout, deepcopy(policy.state_dict())


def _imitate(policy: nn.Module, states: Tensor, actions: Tensor) -> None:
    """Fit a policy to actions ``N x action_dim`` at states ``N x state_dim``, by least squares."""
    scale = actions.std(0, correction=0).clamp_min(1e-12)
    optimizer = torch.optim.Adam(policy.parameters(), lr=5e-3)
    for _ in range(400):
        loss = ((policy(states) - actions) / scale).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
