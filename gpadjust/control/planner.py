"""Sequences of actions that are searched for in a model."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.control.action_sequences import cross_entropy, random_sequences
from gpadjust.control.objectives import Objective, Past
from gpadjust.control.rollouts import Policy, Rollouts
from gpadjust.control.task import Task


class Plan(NamedTuple):
    """What to do in an episode, or in the rest of it.

    Args:
        actions: ``T x action_dim``.
        value: What the objective says of it.
    """

    actions: Tensor
    value: float


@dataclass(frozen=True)
class CrossEntropyPlanner:
    """Plans the actions of an episode by an objective, such as information or return.

    Sequences of actions are proposed, random piecewise constant ones and a policy's own in the
    model; each is followed through functions drawn from the posterior of the dynamics; and the one
    that is worth most, on average over the functions, is taken, after some rounds of the
    cross-entropy method. Give it to :class:`~gpadjust.rl.DynaSAC` as ``exploration``.

    Args:
        objective: What to look for: :class:`Information`, :class:`Return`, or your own.
        num_random: Number of random sequences.
        num_policy: Number of sequences by the policy.
        num_functions: How many functions each is followed through.
        max_hold: The most steps that a random sequence holds an action.
        rounds: Rounds of the cross-entropy method; 0 takes the best of the first sequences.
        num_elites: How many sequences the next round is drawn about.
        replan_every: Number of steps after which the rest of the episode is planned anew, from
            where it is and with what it has already told. Default: the episode goes by the first
            plan.

    Raises:
        TypeError: If the objective is none, or a number is not whole.
        ValueError: If a number is out of range, or there is nothing to choose from.

    Example:
        >>> import torch
        >>> from gpadjust.control import CrossEntropyPlanner, Return, Task
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> point = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + X[:, 1:])
        >>> task = Task(point, lambda states, actions, next_states: -next_states[:, 0].abs())
        >>> bounds = torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
        >>> plan = CrossEntropyPlanner(Return()).plan(task, torch.ones(1).double(), bounds, 3)
        >>> plan.actions.shape, plan.value > -1
        (torch.Size([3, 1]), True)
    """

    objective: Objective
    _: KW_ONLY
    num_random: int = 64
    num_policy: int = 16
    num_functions: int = 3
    max_hold: int = 5
    rounds: int = 2
    num_elites: int = 8
    replan_every: int | None = None

    def __post_init__(self) -> None:
        """Check objective and numbers."""
        if not isinstance(self.objective, Objective):
            raise TypeError(
                "objective must be an object of an Objective, such as Information() or Return(); "
                f"found {self.objective!r}."
            )
        least = {"num_random": 0, "num_policy": 0, "rounds": 0}
        for name in (entry.name for entry in fields(self) if entry.name != "objective"):
            value = getattr(self, name)
            if name == "replan_every" and value is None:
                continue
            if not isinstance(value, int) or isinstance(value, bool):
                raise TypeError(f"{name} must be a whole number; found {value!r}.")
            if value < least.get(name, 1):
                raise ValueError(f"{name} must be at least {least.get(name, 1)}; found {value}.")
        if not self.num_random + self.num_policy:
            raise ValueError(
                "num_random and num_policy are both 0, so that there is no sequence of actions to "
                "choose; raise one of them."
            )

    @torch.no_grad()
    def plan(
        self,
        task: Task,
        state: Tensor,
        action_bounds: Tensor,
        num_steps: int | None = None,
        *,
        policy: Policy | None = None,
        past: Past | None = None,
        known: Tensor | None = None,
    ) -> Plan:
        """Choose the actions of the next steps; the randomness is PyTorch's global generator.

        Args:
            task: The task, whose dynamics have learnt from transitions. Steps beyond its bounds are
                not made.
            state: Where the episode is, ``state_dim``.
            action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``, finite.
            num_steps: How many steps are ahead, ``T``. Default: the episode length of the task.
            policy: Draws actions ``N x action_dim`` at states ``N x state_dim``. Default: none, and
                random sequences in the place of its own.
            past: States and actions of the episode so far, ``t x state_dim`` and
                ``t x action_dim``, which are not learnt yet.
            known: A sequence to choose from as well, ``T x action_dim``.

        Raises:
            TypeError: If the dynamics cannot tell what the objective asks.
            ValueError: If ``state`` or ``action_bounds`` have another shape, bounds are not finite,
                or nobody says how many steps there are.
            RuntimeError: If the dynamics have learnt nothing yet.
            PhysicsError: If the physics fails at ``state``, whatever the action.
        """
        spec = task.dynamics.spec
        if state.shape != (spec.state_dim,):
            raise ValueError(
                f"Expected state of shape {spec.state_dim}, found {tuple(state.shape)}."
            )
        if action_bounds.shape != (2, spec.action_dim) or not action_bounds.isfinite().all():
            raise ValueError(
                f"Expected finite action_bounds of shape 2 x {spec.action_dim}, found "
                f"{action_bounds.tolist()}."
            )
        num_steps = task.episode_length if num_steps is None else num_steps
        if num_steps is None or num_steps < 1:
            raise ValueError(
                f"Expected num_steps as a number of steps >= 1, found {num_steps}; pass it, or "
                "give the task an episode_length."
            )
        if known is not None and known.shape != (num_steps, spec.action_dim):
            raise ValueError(
                f"Expected known of shape {num_steps} x {spec.action_dim}, found "
                f"{tuple(known.shape)}."
            )
        score = self.objective.of(task)
        rollouts = Rollouts(task, self.num_functions)
        num_random = self.num_random + (self.num_policy if policy is None else 0)
        first = [random_sequences(num_random, num_steps, action_bounds, self.max_hold)]
        if policy is not None and self.num_policy:
            proposed = rollouts.propose(state, num_steps, policy, self.num_policy)
            first.append(proposed.clamp(action_bounds[0], action_bounds[1]))
        if known is not None:
            first.append(known.unsqueeze(0))
        return Plan(
            *cross_entropy(
                lambda sequences: score(rollouts.follow(state, sequences), past),
                torch.cat(first),
                action_bounds,
                self.rounds,
                self.num_elites,
            )
        )
