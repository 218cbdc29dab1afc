"""Limits and prices of the change of an action from a step to the next one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import checked_number


@dataclass(frozen=True)
class ActionRate:
    """How far an action may be from the one before it, and what its change costs.

    The first action of an episode is free.

    Args:
        most: The most that an action changes in a step, one number for all actions or one for
            each. Default: no limit.
        price: What a step costs for each unit of the sum of its squared changes, beside the
            rewards.

    Raises:
        TypeError: If a number is of another kind.
        ValueError: If ``most`` is not positive, or ``price`` negative.

    Example:
        >>> import torch
        >>> sequence = torch.tensor([[[0.0], [1.0], [-1.0]]])
        >>> ActionRate(most=0.25).limited(sequence).flatten()
        tensor([0.0000, 0.2500, 0.0000])
    """

    most: float | Sequence[float] | None = None
    _: KW_ONLY
    price: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        for each in self._limits if self.most is not None else []:
            checked_number("the most of an action rate", each, above=0)
        checked_number("price", self.price, least=0)

    def check(self, action_dim: int) -> None:
        """Raise a ValueError unless there is one limit, or one for each action."""
        if len(self._limits) not in (1, action_dim):
            raise ValueError(
                f"action_rate must have one limit, or one for each of {action_dim} actions; found "
                f"{len(self._limits)}."
            )

    @property
    def _limits(self) -> list[Any]:
        single = self.most is None or isinstance(self.most, Real | str)
        return [self.most] if single else [*self.most]  # type: ignore[misc]

    def limited(self, sequences: Tensor, before: Tensor | None = None) -> Tensor:
        """Sequences ``n x T x action_dim`` that follow as fast as they may.

        Args:
            sequences: What is wanted.
            before: The action before the first one, ``action_dim``; None at the start.
        """
        if self.most is None:
            return sequences
        most = torch.tensor(self._limits, dtype=sequences.dtype)
        steps: list[Tensor] = []
        for wanted in sequences.unbind(-2):
            if before is not None:
                wanted = before + (wanted - before).clamp(-most, most)
            steps.append(wanted)
            before = wanted
        return torch.stack(steps, dim=-2)

    def cost(self, actions: Tensor, before: Tensor | None = None) -> Tensor:
        """Price of each step of ``... x T x action_dim``: ``... x T``."""
        first = actions[..., :1, :] if before is None else before.expand_as(actions[..., :1, :])
        return self.price * torch.cat([first, actions], dim=-2).diff(dim=-2).square().sum(-1)
