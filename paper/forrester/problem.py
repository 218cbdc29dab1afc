"""Forrester's function, its crude versions, and the data."""

from __future__ import annotations

import torch
from torch import Tensor

LOWER, UPPER = -0.6, 1.0
POINTS = torch.linspace(LOWER, UPPER, 40, dtype=torch.float64).unsqueeze(-1)


def forrester(X: Tensor) -> Tensor:
    """Return the function of Forrester et al. (2007), ``(6 x - 2)^2 sin(12 x - 4)``."""
    return (6 * X - 2).square() * torch.sin(12 * X - 4)


def truth(X: Tensor) -> Tensor:
    """Return the paper's true function: a quarter of Forrester's."""
    return forrester(X) / 4


def crude_a(X: Tensor) -> Tensor:
    """Return the crude function as printed, built on the true function with its quarter."""
    return (truth(X) / 2 + 10 * (X - 0.5) + 5) / 4


def crude_b(X: Tensor) -> Tensor:
    """Return the crude function of Forrester's own, so that ``truth = 2 crude - 5 x``."""
    return (forrester(X) / 2 + 10 * (X - 0.5) + 5) / 4


CRUDE = {"A": crude_a, "B": crude_b}


def observations(seed: int, n: int) -> tuple[Tensor, Tensor]:
    """Draw ``n`` noise-free observations at uniform inputs: two ``n x 1`` tensors."""
    generator = torch.Generator().manual_seed(seed)
    X = LOWER + (UPPER - LOWER) * torch.rand(n, 1, generator=generator, dtype=torch.float64)
    return X, truth(X)
