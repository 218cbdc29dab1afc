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
    r"""Return safety margins of the constraints along the planned mean.

    The covariance :math:`\Sigma` of the states is carried along the plan: noise differs from step
    to step, the error of the mean has the same direction in all. A linear feedback corrects
    deviations, as later plans will, as far as the actions leave room. With the slope g of a
    constraint its margin is

    .. math:: \Phi^{-1}(1 - \epsilon)\, \sqrt{g^\top \Sigma\, g},

    where the steps of the episode and the constraints share the risk :math:`\epsilon` of the task
    (van Hessem and Bosgra 2002; Hewing, Kabzan and Zeilinger 2020).

    Args:
        task: The task, with constraints and fitted dynamics.
        states: The states of the plan at which the actions are taken, ``T x state_dim``.
        actions: ``T x action_dim``.
        action_bounds: ``2 x action_dim``.
        covariance: Covariance of the estimated state at each step, ``state_dim x state_dim``.
            Default: the states are measured.

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
    estimated = slopes.new_zeros(dim, dim) if covariance is None else covariance
    steps = near._replace(variance=noise).carry(estimated.expand_as(near.slope))
    # The feedback corrects the measured deviation; the error of the estimate stays.
    scattered = slopes.new_zeros(num_constraints, dim, dim)
    biased = slopes.new_zeros(num_constraints, dim, dim)
    results = []
    for t in range(num_steps):
        # The share of the feedback K that the actions leave room for.
        spread = scattered + biased @ biased.mT
        ahead = spread @ (slopes[t] @ near.slope[t]).unsqueeze(-1)
        sd = _variance_along(slopes[t] @ near.slope[t], spread).clamp_min(_TINY).sqrt()
        wanted = quantile * (feedback[t] @ ahead).squeeze(-1) / sd.unsqueeze(-1)
        room = torch.where(wanted > 0, action_bounds[1] - actions[t], actions[t] - action_bounds[0])
        possible = (room / wanted.abs().clamp_min(_TINY)).clamp(0.0, 1.0).amin(-1)
        # S' = (A + B K) S (A + B K)^T + Q
        closed = near.slope[t] + possible[:, None, None] * (near.gain[t] @ feedback[t])
        scattered = closed @ scattered @ closed.mT + steps[t] - estimated
        biased = closed @ biased + unknown[t]
        total = scattered + estimated + biased @ biased.mT
        results.append(quantile * _variance_along(slopes[t], total).clamp_min(0.0).sqrt())
    return torch.stack(results)


def _feedback(near: Linearised, slopes: Tensor, half_range: Tensor) -> Tensor:
    """Return linear-quadratic regulators, ``T x c x action_dim x state_dim``.

    The unit of a deviation is its largest one without feedback, of an action its half range.
    """
    open_loop = torch.zeros_like(near.slope[0])
    largest = slopes.new_zeros(slopes.shape[1])
    for t in range(len(slopes)):
        open_loop = near.slope[t] @ open_loop @ near.slope[t].mT + near.variance[t].diag()
        largest = torch.maximum(largest, _variance_along(slopes[t], open_loop))
    weights = torch.where(largest > _TINY, 1 / largest.clamp_min(_TINY), 0.0)[:, None, None]
    effort = half_range.square().reciprocal().diag()
    value = slopes.new_zeros(len(weights), *near.slope.shape[1:])
    gains = []
    for t in reversed(range(len(slopes))):
        # K = -(R + B^T V B)^-1 B^T V A,  V' = A^T V (A + B K)
        slope, gain = near.slope[t], near.gain[t]
        value = value + weights * slopes[t].unsqueeze(-1) * slopes[t].unsqueeze(-2)
        gains.append(-torch.linalg.solve(effort + gain.mT @ value @ gain, gain.mT @ value @ slope))
        value = slope.mT @ value @ (slope + gain @ gains[-1])
        value = (value + value.mT) / 2
    return torch.stack(gains[::-1])


def _variance_along(slopes: Tensor, covariance: Tensor) -> Tensor:
    """Return the variances ``c`` in the directions of slopes ``c x state_dim``."""
    return ((slopes.unsqueeze(-2) @ covariance).squeeze(-2) * slopes).sum(-1)
