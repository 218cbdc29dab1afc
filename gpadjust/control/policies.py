"""Policies that gradients can improve."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from gpadjust.checks import checked_bounds
from gpadjust.states import StateSpec

_NEAR = 0.95  # of the way to a bound: beyond, the tanh has hardly any slope


class BoundedPolicy(nn.Module):
    r"""Actions within bounds, from what the policy sees of a state.

    .. math:: a = \frac{h + l}{2} + \frac{h - l}{2} \tanh(\pi(z)), \quad z = (o - m) / s,

    where o is the observation (:meth:`~gpadjust.states.StateSpec.observe`) and :math:`\pi` the
    body, whose output is without bounds.

    Args:
        body: Maps ``N x observation_dim`` to ``N x action_dim``, in float64.
        spec: What the entries of states and actions are.
        action_bounds: Lower and upper bounds l and h of the actions, ``2 x action_dim``.

    Example:
        >>> import torch
        >>> from gpadjust.control import mlp_policy
        >>> from gpadjust.states import StateSpec
        >>> policy = mlp_policy(StateSpec(["x"], ["force"]), torch.tensor([[-2.0], [2.0]]))
        >>> policy(torch.zeros(3, 1, dtype=torch.float64)).shape
        torch.Size([3, 1])
    """

    middle: Tensor
    reach: Tensor
    origin: Tensor
    unit: Tensor

    def __init__(self, body: nn.Module, spec: StateSpec, action_bounds: ArrayLike) -> None:
        super().__init__()
        low, high = checked_bounds("action_bounds", action_bounds, spec.action_dim)
        self.body = body
        self.spec = spec
        self.register_buffer("middle", (low + high) / 2)
        self.register_buffer("reach", (high - low) / 2)
        self.register_buffer("origin", torch.zeros(spec.observation_dim, dtype=torch.float64))
        self.register_buffer("unit", torch.ones(spec.observation_dim, dtype=torch.float64))

    def forward(self, states: Tensor) -> Tensor:
        """Actions ``N x action_dim`` at states ``N x state_dim``."""
        return self.act(self.spec.observe(states))

    def act(self, observations: Tensor) -> Tensor:
        """Actions ``N x action_dim`` at observations ``N x observation_dim``."""
        raw = self.body((observations - self.origin) / self.unit)
        return self.middle + self.reach * raw.tanh()

    @property
    def action_bounds(self) -> Tensor:
        """Lower and upper bounds of the actions, ``2 x action_dim``."""
        return torch.stack([self.middle - self.reach, self.middle + self.reach])

    def look_at(self, states: Tensor) -> None:
        """Take the scale of what is seen from states ``N x state_dim``; once, before training."""
        seen = self.spec.observe(states)
        self.origin.copy_(seen.mean(0))
        spread = seen.std(0, correction=0)
        self.unit.copy_(torch.where(spread > 1e-6 * seen.abs().amax(0), spread, 1.0))


def mlp_policy(
    spec: StateSpec,
    action_bounds: ArrayLike,
    net_arch: Sequence[int] = (64, 64),
    first_actions: Sequence[float] | None = None,
) -> BoundedPolicy:
    """A network of layers.

    Args:
        spec: What the entries of states and actions are.
        action_bounds: ``2 x action_dim``.
        net_arch: The widths of the hidden layers; () for a linear function.
        first_actions: About what it does before it has learnt, ``action_dim`` numbers within the
            bounds. Default: their middle, which for muscles, say, is to tense them all.

    Raises:
        ValueError: If ``first_actions`` are beyond the bounds, or another number of them.
    """
    widths = [spec.observation_dim, *net_arch]
    layers: list[nn.Module] = []
    for width, following in pairwise(widths):
        layers += [nn.Linear(width, following, dtype=torch.float64), nn.Tanh()]
    last = nn.Linear(widths[-1], spec.action_dim, dtype=torch.float64)
    with torch.no_grad():
        last.weight.mul_(0.1)  # gentle actions at first
        last.bias.copy_(_before_tanh(first_actions, action_bounds, spec.action_dim))
    return BoundedPolicy(nn.Sequential(*layers, last), spec, action_bounds)


def _before_tanh(actions: Sequence[float] | None, action_bounds: ArrayLike, dim: int) -> Tensor:
    """Return the arguments of a policy's tanh for these actions, ``action_dim``; 0 for None."""
    low, high = checked_bounds("action_bounds", action_bounds, dim)
    if actions is None:
        return torch.zeros_like(low)
    given = torch.as_tensor(actions, dtype=torch.float64)
    if given.shape != low.shape or not ((given >= low) & (given <= high)).all():
        raise ValueError(
            f"first_actions must be {len(low)} numbers within {low.tolist()} and {high.tolist()}; "
            f"found {given.tolist()}."
        )
    share = (2 * given - low - high) / (high - low)
    return share.clamp(-_NEAR, _NEAR).atanh()
