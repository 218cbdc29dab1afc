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
    r"""By how much constraints must hold in the mean of a plan, for them to hold in the system.

    The covariance of the states is carried along the plan, whose deviations are corrected by a
    linear feedback, as they will be by the plans to come: open loop it would grow without limit.
    With the slope g of a constraint its margin is

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
    near = linearised(task.dynamics, states, actions)
    slopes = _slopes(task, near.mean, actions)
    num_steps, num_constraints, dim = slopes.shape
    if task.probability is None:
        return slopes.new_zeros(num_steps, num_constraints)
    feedback = _feedback(near, slopes, (action_bounds[1] - action_bounds[0]) / 2)
    closed = near.slope + near.gain @ feedback
    seen = slopes.new_zeros(dim, dim) if covariance is None else covariance
    # The feedback corrects what will be seen; the error of the estimate stays.
    spread, variances, steps = torch.zeros_like(seen), [], near.carry(seen.expand_as(near.slope))
    for t in range(num_steps):
        total = closed[t] @ spread @ closed[t].mT + steps[t]
        spread = total - seen
        variances.append(_along(slopes[t], total))
    share = (1 - task.probability) / (task.episode_length or num_steps) / num_constraints
    quantile = torch.special.ndtri(torch.tensor(1 - share, dtype=torch.float64))
    return quantile.clamp_min(0.0) * torch.stack(variances).clamp_min(0.0).sqrt()


def _feedback(near: Linearised, slopes: Tensor, half_range: Tensor) -> Tensor:
    """The linear-quadratic regulator of the constraints, ``T x action_dim x state_dim``.

    Their deviations count in those that they would have without it, actions in half their range.
    """
    open_loop, largest = torch.zeros_like(near.slope[0]), slopes.new_zeros(slopes.shape[1])
    for t in range(len(slopes)):
        open_loop = near.slope[t] @ open_loop @ near.slope[t].mT + near.variance[t].diag()
        largest = torch.maximum(largest, _along(slopes[t], open_loop))
    weights = torch.where(largest > _TINY, 1 / largest.clamp_min(_TINY), 0.0)
    effort = half_range.square().reciprocal().diag()
    value, gains = torch.zeros_like(near.slope[0]), []
    for t in reversed(range(len(slopes))):
        slope, gain = near.slope[t], near.gain[t]
        value = value + slopes[t].mT @ (weights.unsqueeze(-1) * slopes[t])
        gains.append(-torch.linalg.solve(effort + gain.mT @ value @ gain, gain.mT @ value @ slope))
        value = slope.mT @ value @ (slope + gain @ gains[-1])
        value = (value + value.mT) / 2
    return torch.stack(gains[::-1])


def _along(slopes: Tensor, covariance: Tensor) -> Tensor:
    """Variances ``c`` in the directions of slopes ``c x state_dim``."""
    return (slopes @ covariance * slopes).sum(-1)


def _slopes(task: Task, states: Tensor, actions: Tensor) -> Tensor:
    """The derivatives of the constraints by the states, ``N x c x state_dim``."""
    with torch.enable_grad():
        at = states.detach().clone().requires_grad_(True)
        return derivatives(task.constraint_values(at, actions), [at])[0]
