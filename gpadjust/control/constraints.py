"""Constraints that hold with a probability: their margins along a plan."""

from __future__ import annotations

import torch
from torch import Tensor

from gpadjust.control.task import Task
from gpadjust.dynamics.linearised import Linearised, derivatives, linearised

_TINY = 1e-12


@torch.no_grad()
def margins(
    task: Task,
    states: Tensor,
    actions: Tensor,
    action_bounds: Tensor,
    covariance: Tensor | None = None,
) -> Tensor:
    r"""Return how far constraints must hold in the mean of a plan, to hold in the system.

    The covariance of the states is carried along the plan: noise is another one in each step, and
    what is not known of the mean errs in the same direction all along. Deviations are corrected by
    a linear feedback, as far as the actions of the plan leave room for it, as they will be by the
    plans to come: open loop they would grow without limit. With the slope g of a constraint its
    margin is

    .. math:: \Phi^{-1}(1 - \epsilon)\, \sqrt{g^\top \Sigma\, g},

    where the risk :math:`\epsilon` is that of the task shared over the steps of the episode and
    the constraints (van Hessem and Bosgra 2002; Hewing, Kabzan and Zeilinger 2020).

    Args:
        task: The task, with constraints; its dynamics are fitted.
        states: The states of the plan at which the actions are taken, ``T x state_dim``.
        actions: ``T x action_dim``.
        action_bounds: ``2 x action_dim``.
        covariance: That of the estimated state at each step, ``state_dim x state_dim``. Default:
            the states are seen.

    Returns:
        ``T x c``, of the states to which the actions lead; zero if the task has no probability.
    """
    if task.probability is None:
        return torch.zeros_like(task.constraint_values(states, actions))
    near = linearised(task.dynamics, states, actions)
    with torch.enable_grad():
        at = near.mean.clone().requires_grad_(True)
        (slopes,) = derivatives(task.constraint_values(at, actions), [at])
    num_steps, num_constraints, dim = slopes.shape
    share = (1 - task.probability) / (task.episode_length or num_steps) / num_constraints
    quantile = torch.special.ndtri(slopes.new_tensor(1 - share)).clamp_min(0.0)
    feedback = _feedback(near, slopes, (action_bounds[1] - action_bounds[0]) / 2)
    noise = task.dynamics.noise_variance(states, actions)
    unknown = (near.variance - noise).clamp_min(0.0).sqrt().diag_embed()
    seen = slopes.new_zeros(dim, dim) if covariance is None else covariance
    steps = near._replace(variance=noise).carry(seen.expand_as(near.slope))
    # The feedback corrects what will be seen; the error of the estimate stays.
    scattered, biased = (slopes.new_zeros(num_constraints, dim, dim) for _ in range(2))
    found = []
    for t in range(num_steps):
        spread = scattered + biased @ biased.mT
        ahead = spread @ (slopes[t] @ near.slope[t]).unsqueeze(-1)
        sd = _along(slopes[t] @ near.slope[t], spread).clamp_min(_TINY).sqrt()
        wanted = quantile * (feedback[t] @ ahead).squeeze(-1) / sd.unsqueeze(-1)
        room = torch.where(wanted > 0, action_bounds[1] - actions[t], actions[t] - action_bounds[0])
        possible = (room / wanted.abs().clamp_min(_TINY)).clamp(0.0, 1.0).amin(-1)
        closed = near.slope[t] + possible[:, None, None] * (near.gain[t] @ feedback[t])
        scattered = closed @ scattered @ closed.mT + steps[t] - seen
        biased = closed @ biased + unknown[t]
        total = scattered + seen + biased @ biased.mT
        found.append(quantile * _along(slopes[t], total).clamp_min(0.0).sqrt())
    return torch.stack(found)


def _feedback(near: Linearised, slopes: Tensor, half_range: Tensor) -> Tensor:
    """Return the linear-quadratic regulators, ``T x c x action_dim x state_dim``.

    Its deviation counts in that which it would have without, actions in half their range.
    """
    open_loop, largest = torch.zeros_like(near.slope[0]), slopes.new_zeros(slopes.shape[1])
    for t in range(len(slopes)):
        open_loop = near.slope[t] @ open_loop @ near.slope[t].mT + near.variance[t].diag()
        largest = torch.maximum(largest, _along(slopes[t], open_loop))
    weights = torch.where(largest > _TINY, 1 / largest.clamp_min(_TINY), 0.0)[:, None, None]
    effort = half_range.square().reciprocal().diag()
    value, gains = slopes.new_zeros(len(weights), *near.slope.shape[1:]), []
    for t in reversed(range(len(slopes))):
        slope, gain = near.slope[t], near.gain[t]
        value = value + weights * slopes[t].unsqueeze(-1) * slopes[t].unsqueeze(-2)
        gains.append(-torch.linalg.solve(effort + gain.mT @ value @ gain, gain.mT @ value @ slope))
        value = slope.mT @ value @ (slope + gain @ gains[-1])
        value = (value + value.mT) / 2
    return torch.stack(gains[::-1])


def _along(slopes: Tensor, covariance: Tensor) -> Tensor:
    """Variances ``c`` in the directions of slopes ``c x state_dim``."""
    return ((slopes.unsqueeze(-2) @ covariance).squeeze(-2) * slopes).sum(-1)
