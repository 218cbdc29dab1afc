"""Reaching with a muscle arm: learners with and without physics, thirty trials, ten seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from paper.control import Control, Scenario
from paper.control import Settings as ControlSettings

if TYPE_CHECKING:
    from paper.control.learner import System

MODEL_FREE_UPDATES = 100  # per episode; the best of 30, 100, 300
SUBSET = 3  # seeds of some scenarios


@dataclass(frozen=True, kw_only=True)
class Settings(ControlSettings):
    """What decides the numbers, for all learners, unless one says otherwise."""

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
    "mf": Scenario("model-free"),
    "mf-best": Scenario("model-free, fewer updates", changes={"updates": MODEL_FREE_UPDATES}),
    "phy": Scenario("Dyna-Phy", "physics"),
    "gp": Scenario("Dyna-GP", "ZeroMeanGP"),
    "cka": Scenario("Dyna-CKA", "CKA"),
    "rra": Scenario("Dyna-RRA", "RRA"),
    "mf-memory": Scenario("model-free, memory", None, _MEMORY, SUBSET),
    "gp-memory": Scenario("Dyna-GP, memory", "ZeroMeanGP", _MEMORY, SUBSET),
    "cka-memory": Scenario("Dyna-CKA, memory", "CKA", _MEMORY),
    "cka-opensim": Scenario("Dyna-CKA, f_p a simulator", "CKA", {"black_box": True}, 1),
}
PAPER = ("mf", "phy", "gp", "cka", "rra")  # those that the paper compares


@dataclass(frozen=True, kw_only=True)
class Arm(Control):
    """Learners reach with an arm of six muscles, computed by OpenSim."""

    out: Path = Path("results/arm")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "arm"
    packages: ClassVar[tuple[str, ...]] = (*Control.packages, "opensim")
    known: ClassVar[Mapping[str, Scenario]] = SCENARIOS
    rmses: ClassVar[Mapping[str, str]] = {
        "theta_s": "theta_s, rad",
        "theta_e": "theta_e, rad",
        "theta_s_dot": "theta_s', rad/s",
        "theta_e_dot": "theta_e', rad/s",
    }

    def check(self) -> None:
        """Whether there are the learners, and OpenSim."""
        from gpadjust.systems.opensim import load_opensim

        super().check()
        load_opensim()

    def system(self, name: str, seed: int) -> System:
        """The arm; nothing in f_p is random."""
        from paper.arm.system import system

        return system(self.known[name], self.settings_of(name))
