"""Reaching with a muscle arm: learners with and without physics, and policies after few trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from paper.cartpole import Control, ControlSettings, Scenario, scenario
from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels

if TYPE_CHECKING:
    from paper.cartpole.control import Setup


@dataclass(frozen=True, kw_only=True)
class Settings(ControlSettings):
    """Settings that decide the numbers, for all learners, unless one says otherwise."""

    episodes: int = 30
    episode_length: int = 15
    last_model_episode: int = 30
    later_updates: int = 15
    evaluate_every: int = 3
    """episodes between two evaluations; the first is before all"""
    map_after: int = 9
    """episodes after which, as at the end, the errors at each target are kept"""
    strength: float = 0.5
    """of the muscles; a healthy arm's is 1"""
    memory: bool = False
    """whether policy and model see the previous action"""
    black_box: bool = False
    """whether OpenSim computes f_p, row by row, in place of the equation of motion"""


_MEMORY = {"memory": True}
SCENARIOS = {
    "mf": scenario("mf", "model-free"),
    # Per episode; the best of 30, 100, 300.
    "mf-best": scenario("mf", "model-free, fewer updates", {"updates": 100}),
    "phy": scenario("phy", "Dyna-Phy"),
    "gp": scenario("gp"),
    "cka": scenario("cka"),
    "rra": scenario("rra"),
    "mf-memory": scenario("mf", "model-free, memory", _MEMORY, 3),
    "gp-memory": scenario("gp", "Dyna-GP, memory", _MEMORY, 3),
    "cka-memory": scenario("cka", "Dyna-CKA, memory", _MEMORY),
    "cka-opensim": scenario("cka", "Dyna-CKA, f_p a simulator", {"black_box": True}, 1),
}
PAPER = ("mf", "phy", "gp", "cka", "rra")  # those that the paper compares


def _check_opensim() -> None:
    from paper.arm.system.opensim import load_opensim

    load_opensim()


@dataclass(frozen=True, kw_only=True)
class Arm(Control):
    """Learners reach with an arm of six muscles, computed by OpenSim."""

    out: Path = Path("results/arm")
    settings: Settings = field(default_factory=Settings)

    axes: ClassVar[Axes] = {"scenario": {name: each.label for name, each in SCENARIOS.items()}}
    packages: ClassVar[tuple[str, ...]] = (*Control.packages, "opensim")
    known: ClassVar[Mapping[str, Scenario]] = SCENARIOS
    rmses: ClassVar[Mapping[str, str]] = {
        "theta_s": "theta_s, rad",
        "theta_e": "theta_e, rad",
        "theta_s_dot": "theta_s', rad/s",
        "theta_e_dot": "theta_e', rad/s",
    }

    def check(self) -> None:
        """Refuse a machine without OpenSim."""
        _check_opensim()

    def setup(self, name: str, seed: int) -> Setup:
        """The arm; nothing in f_p is random."""
        from paper.arm.evaluation import setup

        return setup(self.known[name], self.settings_of(name))


BOUNDS = {"angles": (-2.0, 4.0), "velocities": (-40.0, 40.0)}
"""In rad and rad/s: an episode in a model ends beyond these."""

SENSORS = {"angles": 0.0175, "velocities": 0.05}
"""Standard deviations of the noise of sensors in rad and rad/s, of the arm that has some; it is not
filtered."""


@dataclass(frozen=True, kw_only=True)
class ReachingSettings:
    """Settings that decide the numbers; found with other seeds, of 20 and more."""

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
    """of all muscles, before there are data; at rest they are not tense"""
    noise: float = 0.15
    """standard deviation of the noise on the actions of the first trials"""
    noisy_trials: int = 2
    """how many these are"""
    substeps: int = 8
    """of f_p's integration"""
    strength: float = 0.5
    """of the muscles; a healthy arm's is 1"""


SLOW: dict[str, Any] = {"updates": 100, "starts": 96, "learning_rate": 3e-3}
"""Settings of the learner that searches at the library's learning rate."""


@dataclass(frozen=True, kw_only=True)
class Reaching(Experiment):
    """An arm of six muscles reaches after a few trials, computed by OpenSim."""

    out: Path = Path("results/reaching")
    settings: ReachingSettings = field(default_factory=ReachingSettings)

    axes: ClassVar[Axes] = {
        "system": {
            "plain": "as the paper's",
            "memory": "the previous action is seen",
            "sensors": "noisy sensors",
            "strength": "f_p twice as strong",
        },
        "learner": labels("cka", "phymean", "phy", "fitted", "gp")
        | {"ensemble": "f_p and an ensemble of networks", "cka-slow": "CKA, rate 0.003"},
    }
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "stable_baselines3", "opensim")
    calls: ClassVar[tuple[str, ...]] = (
        "gpadjust.dynamics.LearnedDynamics",
        "gpadjust.control.PolicySearch",
    )

    def check(self) -> None:
        """Refuse a machine without OpenSim."""
        _check_opensim()

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """All seeds; none of the slow learner on other arms than the paper's."""
        system, learner = kind
        return self.seeds if learner != "cka-slow" or system == "plain" else ()

    def settings_of(self, system: str, learner: str) -> ReachingSettings:
        """The settings of a run."""
        settings = self.settings
        if system == "plain" and learner in ("cka", "cka-slow"):
            settings = replace(settings, trials=settings.long_trials)
        return replace(settings, **SLOW) if learner == "cka-slow" else settings

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and what the arm has beside."""
        system, learner = kind
        settings = asdict(self.settings_of(system, learner))
        del settings["long_trials"]
        more: dict[str, Any] = {"sensors": SENSORS} if system == "sensors" else {}
        more |= {"fitted_by": "PhysicsDynamics"} if learner == "fitted" else {}
        return {**settings, "bounds": BOUNDS, **more}
