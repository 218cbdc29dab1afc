"""Reaching with a muscle arm in the first trials, by gradients through what is known of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.comparison import Comparison

SYSTEMS = {
    "plain": "as the paper's",
    "memory": "the previous action is seen",
    "sensors": "noisy sensors",
    "strength": "f_p twice as strong",
}
"""The arms, by name."""

LEARNERS = {
    "cka": "CKA",
    "phymean": "physics mean",
    "phy": "f_p alone",
    "fitted": "f_p, parameters fitted",
    "gp": "GP",
    "ensemble": "f_p and an ensemble of networks",
}
"""What the policy is trained in, by name."""

BOUNDS = {"angles": (-2.0, 4.0), "velocities": (-40.0, 40.0)}
"""In rad and rad/s: an episode in a model ends beyond these."""

SENSORS = {"angles": 0.0175, "velocities": 0.05}
"""Standard deviations of the noise of sensors in rad and rad/s, of the arm that has some; what they
say is not filtered."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers; found with other seeds, of 20 and more."""

    trials: int = 4
    """real trials of a run"""
    long_trials: int = 10
    """of CKA on the paper's arm"""
    episode_length: int = 15
    """steps of 0.2 s"""
    updates: int = 150
    """gradient steps after each trial, and before the first one"""
    starts: int = 96
    """of each update, along the mean of the model"""
    learning_rate: float = 1e-2
    """at the start of the updates"""
    first_action: float = 0.05
    """of all muscles, before the policy has learnt; at rest they are not tense"""
    noise: float = 0.15
    """standard deviation of what is added to the actions of the first trials"""
    noisy_trials: int = 2
    """how many these are"""
    substeps: int = 8
    """of f_p's integration"""
    strength: float = 0.5
    """of the muscles; a healthy arm's is 1"""


@dataclass(frozen=True, kw_only=True)
class Reaching(Comparison):
    """An arm of six muscles reaches after a few trials, computed by OpenSim."""

    out: Path = Path("results/reaching")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "reaching"
    known_systems: ClassVar[Mapping[str, str]] = SYSTEMS
    known_learners: ClassVar[Mapping[str, str]] = LEARNERS
    packages: ClassVar[tuple[str, ...]] = (*Comparison.packages, "stable_baselines3", "opensim")

    def check(self) -> None:
        """Whether there are the arms and the models, and OpenSim."""
        from gpadjust.systems.opensim import load_opensim

        super().check()
        load_opensim()

    def trials(self, system: str, learner: str) -> int:
        """How many trials a run has."""
        is_long = (system, learner) == ("plain", "cka")
        return self.settings.long_trials if is_long else self.settings.trials

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and what the arm has beside."""
        system, learner = kind
        settings = {**asdict(self.settings), "trials": self.trials(system, learner)}
        del settings["long_trials"]
        sensors = {"sensors": SENSORS} if system == "sensors" else {}
        return {**settings, "bounds": BOUNDS, **sensors}
