"""Sequences of actions: random ones, and the search for one that scores best."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


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


def cross_entropy(
    score: Callable[[Tensor], Tensor],
    first: Tensor,
    bounds: Tensor,
    rounds: int,
    num_elites: int,
) -> tuple[Tensor, float]:
    """The sequence that scores best, by the cross-entropy method (Rubinstein 1999).

    Each round draws as many sequences as the first ones from a normal distribution with mean and
    standard deviation of the best so far, step by step, clipped to the bounds. The best stay.

    Args:
        score: Scores of sequences ``n x T x action_dim``, ``n``; higher is better.
        first: The sequences to begin with, ``n x T x action_dim``.
        bounds: Lower and upper bounds of the actions, ``2 x action_dim``.
        rounds: Number of rounds; with 0 the best of the first ones is returned.
        num_elites: How many are the best.

    Returns:
        The sequence, ``T x action_dim``, and its score.
    """
    sequences, scores = first, score(first)
    for _ in range(rounds):
        best = scores.topk(min(num_elites, len(scores))).indices
        sequences, scores = sequences[best], scores[best]
        mean, sd = sequences.mean(0), sequences.std(0, correction=0)
        drawn = torch.clamp(mean + sd * torch.randn_like(first), bounds[0], bounds[1])
        sequences, scores = torch.cat([sequences, drawn]), torch.cat([scores, score(drawn)])
    found = int(scores.argmax())
    return sequences[found], float(scores[found])
