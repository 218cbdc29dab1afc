"""Which real trials teach the dynamics of a cart-pole most: random, SAC's or informative ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from paper.cartpole import RMSES
from paper.cartpole import Settings as CartPoleSettings
from paper.control import Control, Scenario

if TYPE_CHECKING:
    from paper.control.learner import System

EPISODES = 15
FEW = 3  # episodes after the first


@dataclass(frozen=True, kw_only=True)
class Settings(CartPoleSettings):
    """What decides the numbers, for all learners, unless one says otherwise."""

    episodes: int = EPISODES
    last_model_episode: int = EPISODES
    updates_per_model_step: float = 1
    explore_episodes: int = 0
    """how many episodes after the first are planned"""
    num_random: int = 64
    """random sequences of a plan"""
    num_policy: int = 16
    """sequences of the policy"""
    num_functions: int = 3
    """functions that each sequence is followed through"""
    max_hold: int = 5
    """the most steps that a random action is held"""
    rounds: int = 2
    """of the cross-entropy method"""
    num_elites: int = 8
    """of the cross-entropy method"""
    replan_every: int | None = None
    """steps between two plans; default: one plan an episode"""


MODELS = {"cka": ("Dyna-CKA", "CKA"), "gp": ("Dyna-GP", "ZeroMeanGP")}
_RANDOM = {"num_random": 1, "num_policy": 0, "num_functions": 1, "rounds": 0}
EXPLORERS: dict[str, tuple[str, dict[str, Any]]] = {
    "random": ("random trials", {"explore_episodes": EPISODES - 1, **_RANDOM}),
    "sac": ("SAC's trials", {}),
    "info": ("informative trials", {"explore_episodes": EPISODES - 1}),
    "info-3": ("3 informative trials, then SAC's", {"explore_episodes": FEW}),
}
REFERENCE = "sac"
"""The explorer that the others are compared with, seed by seed and model by model."""

SCENARIOS = {
    f"{name}-{explorer}": Scenario(f"{model_label}, {label}", model, changes)
    for name, (model_label, model) in MODELS.items()
    for explorer, (label, changes) in EXPLORERS.items()
}
_SHARED = {entry.name for entry in fields(CartPoleSettings)}
PLANS = tuple(entry.name for entry in fields(Settings) if entry.name not in _SHARED)


@dataclass(frozen=True, kw_only=True)
class Exploration(Control):
    """Cart-poles whose first real trials are random, SAC's, or informative."""

    out: Path = Path("results/exploration")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "exploration"
    known: ClassVar[Mapping[str, Scenario]] = SCENARIOS
    rmses: ClassVar[Mapping[str, str]] = RMSES

    def system(self, name: str, seed: int) -> System:
        """The cart-pole, and who plans its episodes."""
        from paper.exploration.held_out import system

        return system(self.known[name], self.settings_of(name), seed)
