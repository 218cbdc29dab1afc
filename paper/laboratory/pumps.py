"""Simulated pumps, whose heads differ from the catalogue's curve, which is f_p."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

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


def measured(head: Tensor, generator: torch.Generator) -> Tensor:
    """Heads with noise."""
    return head + NOISE * torch.randn(head.shape, generator=generator, dtype=torch.float64)


class Wear:
    """Observations of a pump that wears slowly, and breaks a little once.

    Args:
        steps: Number of them.
        seed: Of the pump, and all else.
        wears: False for a pump that stays as it is.

    Attributes:
        X: Inputs, ``steps x 2``, which wander through the range.
        truth: Heads, ``steps x 1``, and ``Y`` with noise.
        breaks: The step of the sudden change.
    """

    def __init__(self, steps: int, seed: int, wears: bool = True) -> None:
        generator = torch.Generator().manual_seed(seed)
        pump = Pump.drawn(generator)
        low, high = (torch.tensor(end, dtype=torch.float64) for end in (LOWER, UPPER))
        drawn = torch.randn(steps, 2, generator=generator, dtype=torch.float64)
        kept = torch.tensor([math.exp(-1 / 6), math.exp(-1 / 12)], dtype=torch.float64)
        z = drawn.clone()
        for i in range(1, steps):
            z[i] = kept * z[i - 1] + (1 - kept.square()).sqrt() * drawn[i]
        share = 0.5 * (1 + torch.erf(z / math.sqrt(2)))
        self.X = low + (high - low) * share
        self.breaks = int(steps * (0.55 + 0.2 * torch.rand(1, generator=generator).item()))
        time = torch.arange(steps, dtype=torch.float64).unsqueeze(-1) / steps * wears
        broken = (torch.arange(steps).unsqueeze(-1) >= self.breaks) * float(wears)
        worn: Any = pump.worn + 0.08 * time
        leak: Any = pump.leak + 0.08 * time + 0.06 * broken
        self.truth = replace(pump, worn=worn, leak=leak).head(self.X)
        self.Y = measured(self.truth, generator)
