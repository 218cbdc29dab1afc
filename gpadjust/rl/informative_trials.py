"""Real trials that are made for what they teach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics, TrajectoryInformation
from gpadjust.rl.action_sequences import cross_entropy, random_sequences
from gpadjust.rl.model_vec_env import Termination
from gpadjust.rl.sampled_rollouts import Policy, SampledRollouts


class TrialPlan(NamedTuple):
    """What to do in a trial, or in the rest of it.

    Args:
        actions: ``T x action_dim``.
        information: What the trial would teach, the steps before this plan included, in nats.
    """

    actions: Tensor
    information: float


@dataclass(frozen=True, kw_only=True)
class InformativeTrials:
    """Plans real trials by what their transitions would tell about the dynamics.

    Sequences of actions are proposed, random piecewise constant ones and the policy's own
    in the model; each is followed through functions drawn from the posterior of the dynamics; and
    the one of the most :class:`~gpadjust.dynamics.TrajectoryInformation`, averaged over the
    functions, is taken, after some rounds of the cross-entropy method. Give it to
    :class:`~gpadjust.rl.DynaSAC` as ``exploration``.

    What is informative need not matter for the task: bound the states that are worth knowing
    (``state_bounds`` of ``DynaSAC``), and let the policy act after a few such trials.

    Args:
        num_random: Number of random sequences.
        num_policy: Number of sequences by the policy.
        num_functions: How many functions each is followed through.
        max_hold: The most steps that a random sequence holds an action.
        rounds: Rounds of the cross-entropy method; 0 takes the best of the first sequences.
        num_elites: How many sequences the next round is drawn about.
        replan_every: Number of steps after which the rest of the trial is planned anew, from where
            it is and with what it has already told. Default: the trial goes by the first plan.

    Raises:
        TypeError: If a number is not whole.
        ValueError: If a number is out of range, or there is nothing to choose from.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import CKADynamics, StateSpec
        >>> from gpadjust.rl import InformativeTrials
        >>> dynamics = CKADynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + 0.1 * X[:, 1:])
        >>> x, v = torch.rand(2, 8, 1, dtype=torch.float64)
        >>> dynamics.update(x, v, x + 0.12 * v)
        >>> bounds = torch.tensor([[-2.0], [2.0]], dtype=torch.float64)
        >>> plan = InformativeTrials().plan(dynamics, x[0], 5, bounds)
        >>> plan.actions.shape
        torch.Size([5, 1])
    """

    num_random: int = 64
    num_policy: int = 16
    num_functions: int = 3
    max_hold: int = 5
    rounds: int = 2
    num_elites: int = 8
    replan_every: int | None = None

    def __post_init__(self) -> None:
        """Check the numbers."""
        least = {"num_random": 0, "num_policy": 0, "rounds": 0}
        for name, value in vars(self).items():
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
        dynamics: Dynamics,
        state: Tensor,
        num_steps: int,
        action_bounds: Tensor,
        *,
        policy: Policy | None = None,
        state_bounds: Tensor | None = None,
        terminated: Termination | None = None,
        past: tuple[Tensor, Tensor] | None = None,
        known: Tensor | None = None,
    ) -> TrialPlan:
        """Choose the actions of the next steps; the randomness is PyTorch's global generator.

        Args:
            dynamics: Dynamics that have learnt from transitions.
            state: Where the trial is, ``state_dim``.
            num_steps: How many steps are ahead, ``T``.
            action_bounds: Lower and upper bounds of the actions, ``2 x action_dim``, finite.
            policy: Draws actions ``N x action_dim`` at states ``N x state_dim``. Default: none, and
                random sequences in the place of its own.
            state_bounds: Bounds of the states, ``2 x state_dim``: steps beyond them do not count.
                Default: none.
            terminated: Which states ``N x state_dim`` end a trial. Default: none.
            past: States and actions of the trial so far, ``t x state_dim`` and ``t x action_dim``,
                which are not learnt yet.
            known: A sequence to choose from as well, ``T x action_dim``.

        Raises:
            TypeError: If the dynamics cannot tell what transitions teach.
            ValueError: If ``state`` or ``action_bounds`` have another shape, or bounds are not
                finite.
            RuntimeError: If the dynamics have learnt nothing yet.
            PhysicsError: If the physics fails at ``state``, whatever the action.
        """
        spec = dynamics.spec
        if state.shape != (spec.state_dim,):
            raise ValueError(
                f"Expected state of shape {spec.state_dim}, found {tuple(state.shape)}."
            )
        if action_bounds.shape != (2, spec.action_dim) or not action_bounds.isfinite().all():
            raise ValueError(
                f"Expected finite action_bounds of shape 2 x {spec.action_dim}, found "
                f"{action_bounds.tolist()}."
            )
        information = TrajectoryInformation(dynamics)
        rollouts = SampledRollouts(dynamics, self.num_functions, state_bounds, terminated)

        def teaches(sequences: Tensor) -> Tensor:
            steps = rollouts.follow(state, sequences)
            if not steps.made.any():
                return torch.zeros(len(sequences), dtype=torch.float64)
            if past is None:
                return information(*steps).mean(0)
            done = (*past, torch.ones(len(past[0]), dtype=torch.bool))
            whole = (_prepend(part, ahead) for part, ahead in zip(done, steps, strict=True))
            return information(*whole).mean(0)

        num_random = self.num_random + (self.num_policy if policy is None else 0)
        first = [random_sequences(num_random, num_steps, action_bounds, self.max_hold)]
        if policy is not None and self.num_policy:
            proposed = rollouts.propose(state, num_steps, policy, self.num_policy)
            first.append(proposed.clamp(action_bounds[0], action_bounds[1]))
        if known is not None:
            first.append(known.unsqueeze(0))
        return TrialPlan(
            *cross_entropy(teaches, torch.cat(first), action_bounds, self.rounds, self.num_elites)
        )


def _prepend(done: Tensor, ahead: Tensor) -> Tensor:
    """Steps ``t x ...`` before those of all trials, ``k x n x T x ...``."""
    return torch.cat([done.expand(*ahead.shape[:2], *done.shape), ahead], dim=2)
