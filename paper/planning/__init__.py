"""Swinging up cart-poles in the first trials, by planning in what is known of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from paper.common.comparison import Comparison

SYSTEMS = {
    "plain": "as the paper's",
    "friction": "dry friction and drag",
    "strong-friction": "strong dry friction and drag",
    "sensors": "noisy sensors",
    "mc-pilco": "in MC-PILCO's protocol",
}
"""The cart-poles, by name. The friction is none that f_p has, whatever its parameters."""

LEARNERS = {
    "cka": "CKA",
    "phymean": "physics mean",
    "phy": "f_p alone",
    "fitted": "f_p and viscous friction, fitted",
    "gp": "GP",
    "rra": "RRA",
    "search": "CKA, policy search",
    "oracle": "the true system",
}
"""What is planned in, by name."""

FRICTIONS = {"friction": (0.3, 0.005), "strong-friction": (0.6, 0.01)}
"""Dry friction of the cart in N, and drag of the pole in N m s²/rad², of systems that have some."""

SENSORS = {"x": 0.01, "theta": 0.01, "x_dot": 0.05, "theta_dot": 0.05}
"""Standard deviations of the noise of sensors, of the system that has some; not filtered."""

MC_PILCO: Mapping[str, Any] = {
    "trials": 6,
    "random_trials": 1,
    "episode_length": 60,
    "time_step": 0.05,
    "horizon": 16,
    "rounds": 2,
}
"""The protocol of Amadio et al. 2022, a random trial and five of 3 s; and how it is planned."""

OF_A_SEARCH = ("updates", "starts", "learning_rate", "guides")
"""The settings of which only the search for a policy has need."""

BOUND = 50.0
"""Of all entries of the state, in m, rad and s, where a policy is searched for."""

SMALL_NOISE = 0.01
"""In that protocol, the standard deviation of the noise of all sensors, and of the starts."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers; found with the true system and other seeds (``tuning.py``)."""

    trials: int = 5
    """real trials of a run, the first of which goes by f_p"""
    random_trials: int = 0
    """the first of these, if they have random forces"""
    episode_length: int = 25
    """steps of a trial"""
    time_step: float = 0.1
    """in s"""
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
    updates: int = 150
    """of the policy, after each trial, where one is searched for"""
    starts: int = 192
    """of an update"""
    learning_rate: float = 3e-3
    """at the start of the updates"""
    guides: int = 32
    """planned episodes that the policy imitates at first"""


@dataclass(frozen=True, kw_only=True)
class Planning(Comparison):
    """Cart-poles that are swung up by planning, with several models of them."""

    out: Path = Path("results/planning")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "planning"
    known_systems: ClassVar[Mapping[str, str]] = SYSTEMS
    known_learners: ClassVar[Mapping[str, str]] = LEARNERS
    packages: ClassVar[tuple[str, ...]] = (*Comparison.packages, "stable_baselines3")

    def settings_of(self, system: str) -> Settings:
        """The settings for a system."""
        return replace(self.settings, **MC_PILCO) if system == "mc-pilco" else self.settings

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and what the system has that f_p lacks."""
        system, learner = kind
        settings = asdict(self.settings_of(system))
        if learner != "search":
            settings = {name: each for name, each in settings.items() if name not in OF_A_SEARCH}
        more: dict[str, Any] = {"friction": FRICTIONS[system]} if system in FRICTIONS else {}
        more |= {"sensors": SENSORS} if system == "sensors" else {}
        more |= {"small_noise": SMALL_NOISE} if system == "mc-pilco" else {}
        return {**settings, **more}
