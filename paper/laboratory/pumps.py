"""Simulated pumps, whose heads differ from the catalogue's curve, which is f_p."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

NOISE = 0.2
"""Standard deviation of a measured head, in m."""
LOWER, UPPER = (0.2, 0.7), (1.2, 1.1)
"""Ranges of the flow, in 10 l/s, and of the speed, in that of the catalogue."""


def catalogue(X: Tensor) -> Tensor:
    """The head in m by the curve of the catalogue and the affinity laws, ``... x n x 1``."""
    flow, speed = X.split(1, dim=-1)
    return 40 * speed**2 - 18 * flow**2


@dataclass(frozen=True)
class Pump:
    """A pump with losses that the catalogue leaves out.

    Args:
        worn: Share of the head that wear takes.
        leak: Internal leakage at the speed of the catalogue, in 10 l/s.
        shock: Loss in m by the angle of the flow at the impeller, away from ``design``.
        design: The flow at the speed of the catalogue where there is none.
        stall: Depth in m of the dip where the flow is low.
        where: The flow at the speed of the catalogue in its middle.
    """

    worn: float = 0.06
    leak: float = 0.08
    shock: float = 6.0
    design: float = 0.75
    stall: float = 3.0
    where: float = 0.4

    def head(self, X: Tensor) -> Tensor:
        """The head in m, ``... x n x 1``."""
        flow, speed = X.split(1, dim=-1)
        ideal = 40 * (1 - self.worn) * speed**2 - 18 * (flow + self.leak * speed) ** 2
        ratio = flow / speed
        lost = self.shock * (ratio - self.design) ** 2
        lost = lost + self.stall * (-(((ratio - self.where) / 0.15) ** 2)).exp()
        return ideal - lost * speed**2

    @classmethod
    def drawn(cls, generator: torch.Generator, spread: float = 0.25) -> Pump:
        """A pump of the kind, with parameters of its own."""
        z = torch.randn(6, generator=generator, dtype=torch.float64) * spread
        factors = [*z[:3].exp().tolist(), *(1 + 0.3 * z[3:4]).tolist()]
        factors += [z[4].exp().item(), 1 + 0.3 * z[5].item()]
        typical = cls()
        values = (getattr(typical, name) for name in cls.__dataclass_fields__)
        return cls(*(value * factor for value, factor in zip(values, factors, strict=True)))


class OtherMachine:
    """A machine whose head differs from the catalogue's by a function that has no cause here.

    Args:
        generator: Draws it.
        lengths: Its lengthscales in flow and speed.
    """

    def __init__(self, generator: torch.Generator, lengths: tuple[float, float]) -> None:
        shape = (64, 2)
        self.frequencies = torch.randn(shape, generator=generator, dtype=torch.float64)
        self.frequencies = self.frequencies / torch.tensor(lengths, dtype=torch.float64)
        self.phases = 2 * math.pi * torch.rand(64, generator=generator, dtype=torch.float64)
        self.weights = torch.randn(64, generator=generator, dtype=torch.float64)
        self.constant = 3 * torch.randn(1, generator=generator, dtype=torch.float64)

    def head(self, X: Tensor) -> Tensor:
        """The head in m, ``... x n x 1``."""
        waves = (X @ self.frequencies.mT + self.phases).cos() @ self.weights
        away = self.constant + 2 * math.sqrt(2 / 64) * waves.unsqueeze(-1)
        return catalogue(X) + away


def inputs(number: int, generator: torch.Generator) -> Tensor:
    """Inputs all over the range, ``number x 2``."""
    low, high = (torch.tensor(end, dtype=torch.float64) for end in (LOWER, UPPER))
    return low + (high - low) * torch.rand(number, 2, generator=generator, dtype=torch.float64)


def measured(head: Tensor, generator: torch.Generator) -> Tensor:
    """Heads with noise."""
    return head + NOISE * torch.randn(head.shape, generator=generator, dtype=torch.float64)
