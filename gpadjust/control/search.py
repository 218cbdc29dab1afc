"""The search for the sequence of actions that scores best."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from gpadjust.checks import checked_number, checked_whole

SequenceScore = Callable[[Tensor], Tensor]
"""Scores ``n`` of sequences ``n x T x action_dim``, higher is better."""


@dataclass(frozen=True)
class CrossEntropy:
    """The cross-entropy method (Rubinstein 1999).

    Each round draws as many sequences as the first ones from a normal distribution with mean and
    standard deviation of the best so far, step by step, clipped to the bounds. The best stay.

    Args:
        rounds: Rounds after the first sequences; 0 takes the best of these.
        num_elites: How many are the best.
        correlation: Of the deviations from the mean of a step and the next one, in [0, 1): higher
            for smoother actions (Pinneri et al. 2020).

    Raises:
        TypeError: If a number is of another kind.
        ValueError: If it is out of range.
    """

    rounds: int = 2
    _: KW_ONLY
    num_elites: int = 8
    correlation: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        checked_whole("rounds", self.rounds, 0)
        checked_whole("num_elites", self.num_elites, 1)
        checked_number("correlation", self.correlation, least=0, below=1)

    def best(self, score: SequenceScore, first: Tensor, bounds: Tensor) -> tuple[Tensor, float]:
        """Search, from PyTorch's generator.

        Args:
            score: What is sought; it is asked once a round, about as many sequences as there are
                first ones. When there is no time left, it raises an exception, which comes through.
            first: The sequences to begin with, ``n x T x action_dim``.
            bounds: Lower and upper bounds of the actions, ``2 x action_dim``.

        Returns:
            The sequence, ``T x action_dim``, one of those whose score was asked, and its score.
        """
        sequences, scores = first, score(first)
        for _ in range(self.rounds):
            elites = scores.topk(min(self.num_elites, len(scores))).indices
            sequences, scores = sequences[elites], scores[elites]
            mean, sd = sequences.mean(0), sequences.std(0, correction=0)
            noise = correlated_noise(first.shape, self.correlation)
            drawn = torch.clamp(mean + sd * noise, bounds[0], bounds[1])
            sequences, scores = torch.cat([sequences, drawn]), torch.cat([scores, score(drawn)])
        found = int(scores.argmax())
        return sequences[found], float(scores[found])


def random_sequences(n: int, num_steps: int, bounds: Tensor, max_hold: int) -> Tensor:
    """Draw piecewise constant sequences, from PyTorch's generator.

    Each holds its actions, uniform within the bounds, for a number of steps of its own, from 1 to
    ``max_hold``.

    Args:
        n: Number of sequences.
        num_steps: Their length ``T``.
        bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
        max_hold: The most steps that an action is held.

    Returns:
        ``n x T x action_dim``.
    """
    low, high = bounds
    actions = low + (high - low) * torch.rand(n, num_steps, len(low), dtype=torch.float64)
    hold = torch.randint(1, max_hold + 1, (n, 1))
    rows = torch.arange(num_steps) // hold
    return actions.gather(1, rows.unsqueeze(-1).expand_as(actions))


def correlated_noise(shape: torch.Size, correlation: float) -> Tensor:
    """Standard normal noise ``n x T x a`` whose steps are correlated, from PyTorch's generator."""
    noise = torch.randn(shape, dtype=torch.float64)
    if correlation:
        fresh = math.sqrt(1 - correlation**2)
        for t in range(1, shape[1]):
            noise[:, t] = correlation * noise[:, t - 1] + fresh * noise[:, t]
    return noise
