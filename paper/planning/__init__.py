"""Swinging up cart-poles in the first trials, by planning in what is known of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.comparison import Comparison

SYSTEMS = {
    "plain": "as the paper's",
    "friction": "dry friction and drag",
    "strong-friction": "strong dry friction and drag",
    "sensors": "noisy sensors",
}
"""The cart-poles, by name. The friction is none that f_p has, whatever its parameters."""

LEARNERS = {
    "cka": "CKA",
    "phymean": "physics mean",
    "phy": "f_p alone",
    "fitted": "f_p, parameters fitted",
    "gp": "GP",
    "rra": "RRA",
    "oracle": "the true system",
}
"""What is planned in, by name."""

FRICTIONS = {"friction": (0.3, 0.005), "strong-friction": (1.0, 0.015)}
"""Dry friction of the cart in N, and drag of the pole in N m s²/rad², of systems that have some."""

SENSORS = {"x": 0.01, "theta": 0.01, "x_dot": 0.05, "theta_dot": 0.05}
"""Standard deviations of the noise of sensors, of the system that has some; not filtered."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers; found with the true system and other seeds (``tuning.py``)."""

    trials: int = 5
    """real trials of a run, the first of which goes by f_p"""
    episode_length: int = 25
    """steps of 0.1 s"""
    horizon: int = 8
    """steps that are planned ahead at each step"""
    sequences: int = 128
    """of these, in each round of the cross-entropy method"""
    spread: float = 0.15
    """of these about the earlier plan, in shares of the range of forces"""
    rounds: int = 1
    """of these after the first"""
    elites: int = 12
    """of these"""
    first_sequences: int = 128
    """of the plan when a trial begins, of all its steps"""
    first_rounds: int = 12
    """of these"""
    restarts: int = 3
    """of these"""
    correlation: float = 0.5
    """of deviations of a step and the next"""


@dataclass(frozen=True, kw_only=True)
class Planning(Comparison):
    """Cart-poles that are swung up by planning, with several models of them."""

    out: Path = Path("results/planning")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "planning"
    known_systems: ClassVar[Mapping[str, str]] = SYSTEMS
    known_learners: ClassVar[Mapping[str, str]] = LEARNERS
    packages: ClassVar[tuple[str, ...]] = (*Comparison.packages, "stable_baselines3")

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and what the system has that f_p lacks."""
        system = kind[0]
        more: dict[str, Any] = {"friction": FRICTIONS[system]} if system in FRICTIONS else {}
        more |= {"sensors": SENSORS} if system == "sensors" else {}
        return {**asdict(self.settings), **more}
