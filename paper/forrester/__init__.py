"""Forrester's function: seven models, eight observations, a hundred runs (the paper's sec. 3.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment

READINGS = {"B": "built on Forrester's function, so that truth = 2 f_p - 5 x", "A": "as printed"}
PROTOCOLS = {"paper": "paper's protocol", "gpadjust": '`fit(model, "map")`'}
GRID = "closed form"  # RRA as printed, on a grid of lengthscales and ridges
OTHER = "other settings"  # the paper's protocol with other steps of Adam and noise variances


@dataclass(frozen=True, kw_only=True)
class Forrester(Experiment):
    """Seven models learn Forrester's function (figure 1), by two protocols of training."""

    runs: int = 100  # data sets; the number is the seed
    observations: int = 8  # noise-free observations of a data set
    noise: float = 0.01  # the fixed noise variance of the paper's protocol, and its ridge
    steps: int = 50  # of Adam, in the paper's protocol
    rate: float = 0.1  # of Adam, in the paper's protocol
    lengthscales: tuple[float, ...] = (0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
    """of the literal closed form of RRA, on a grid"""
    ridges: tuple[float, ...] = (1e-6, 1e-4, 1e-2, 1.0)
    """of the literal closed form of RRA, on a grid"""

    axes: ClassVar[Axes] = {"reading": READINGS, "protocol": PROTOCOLS | {GRID: GRID, OTHER: OTHER}}
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.RRA")
    curves: ClassVar[tuple[str, ...]] = ("B", "paper")
    digits: ClassVar[int] = 5
    quick: ClassVar[Mapping[str, Any]] = {}

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Return all seeds; of the grids, for reading B alone."""
        return () if kind[0] == "A" and kind[1] in (GRID, OTHER) else self.seeds
