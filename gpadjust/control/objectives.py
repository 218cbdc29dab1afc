"""What a sequence of actions is worth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from gpadjust.checks import checked_number
from gpadjust.control.rollouts import Rollout
from gpadjust.control.task import Task, per_row

_BACK = 10.0  # largest rewards of a step: few episodes of a policy must outweigh those that stay

Score = Callable[[Rollout], Tensor]
"""The worth ``n`` of the ``n`` sequences of a rollout, higher is better."""


class Objective(ABC):
    """What a planner looks for."""

    @property
    def compares_functions(self) -> bool:
        """Whether it matters that the functions are followed from the same starts."""
        return True

    def check_functions(self, num_functions: int | None) -> None:  # noqa: B027 - most need nothing
        """Raise a ValueError if it means nothing of so many functions; None for the mean."""

    @abstractmethod
    def of(self, task: Task) -> Score:
        """The worth of rollouts in a task, as its dynamics stand."""


@dataclass(frozen=True)
class Return(Objective):
    """The sum of rewards of the steps ahead, averaged over the functions, or a quantile of these.

    Leaving the bounds never pays: each step that an episode does not make for that costs a million
    times the largest that was at stake in the first rollouts (reward, effort or terminal value of
    an episode), so that sequences that leave come after all others, and those that leave later
    first. Beside it such an episode has the gradient of how far it left, for a policy to come back.

    Args:
        discount: Factor of the rewards from a step to the next one.
        quantile: Of the returns in the functions the one that counts, such as 0.2 to be careful
            about what the model does not know. Default: their mean.
        effort: What a step costs for each unit of its sum of squared actions, beside the rewards.
        terminal_value: What a state at the end of the steps ahead is worth, ``N`` of states
            ``N x state_dim``, such as the return from there on. Default: nothing.

    Raises:
        TypeError: If a number is of another kind, or ``terminal_value`` is no function.
        ValueError: If a number is out of range.
    """

    discount: float = 1.0
    _: KW_ONLY
    quantile: float | None = None
    effort: float = 0.0
    terminal_value: Callable[[Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        """Check numbers and function."""
        checked_number("discount", self.discount, above=0, most=1)
        if self.quantile is not None:
            checked_number("quantile", self.quantile, least=0, below=1)
        checked_number("effort", self.effort, least=0)
        if self.terminal_value is not None and not callable(self.terminal_value):
            raise TypeError(
                "terminal_value must be a function of states, or None; found "
                f"{self.terminal_value!r}."
            )

    @property
    def compares_functions(self) -> bool:
        """Whether it matters that the functions are followed from the same starts."""
        return self.quantile is not None

    def check_functions(self, num_functions: int | None) -> None:
        """Raise a ValueError for a quantile over a single function."""
        if self.quantile is not None and (num_functions or 1) < 2:
            raise ValueError(
                f"Return(quantile={self.quantile}) is one over functions, but num_functions is "
                f"{num_functions}, {'the mean alone' if num_functions is None else 'one of them'}; "
                "give num_functions of at least 2, such as 16."
            )

    def of(self, task: Task) -> Score:
        """The return of rollouts."""
        largest = torch.zeros((), dtype=torch.float64)

        def score(rollout: Rollout) -> Tensor:
            nonlocal largest
            rewards = rollout.rewards.double()
            if self.effort:
                rewards = rewards - self.effort * rollout.actions.square().sum(-1)
            weights = self.discount ** torch.arange(rewards.shape[-1] + 1, dtype=torch.float64)
            ends = weights[-1] * self._at_the_end(rollout)
            if not largest:  # of the first rollouts, so that later ones compare
                largest = torch.maximum(*(part.detach().abs().max() for part in (rewards, ends)))
            returns = (weights[:-1] * rewards.masked_fill(~rollout.made, 0.0)).sum(-1) + ends
            if rollout.left_bounds.any():
                lost = rollout.left_bounds.unsqueeze(-1) & ~rollout.made
                missed = 1e6 * (weights[:-1] * lost).sum(-1)
                price = torch.where(largest > 0, largest, 1.0)
                returns = returns - price * (missed + _BACK * len(weights) * rollout.overshoot)
            if self.quantile is None:
                return returns.mean(0)
            return returns.quantile(self.quantile, dim=0)

        return score

    def _at_the_end(self, rollout: Rollout) -> Tensor:
        """What the last states are worth, ``k x n``; nothing where an episode has ended."""
        last, made = rollout.next_states[:, :, -1], rollout.made[:, :, -1]
        if self.terminal_value is None:
            return torch.zeros(made.shape, dtype=torch.float64)
        values = per_row(self.terminal_value(last.flatten(0, 1)), made.numel(), "terminal_value")
        return values.double().unflatten(0, made.shape).masked_fill(~made, 0.0)
