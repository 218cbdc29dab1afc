"""Reaching with a muscle arm: learners with and without physics (the paper's sec. 3.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from paper.cartpole import Control, Scenario, scenario
from paper.common.experiment import Axes

if TYPE_CHECKING:
    from paper.cartpole.control import Setup


SCENARIOS = {
    "mf": scenario("mf", "model-free"),
    # Per episode; the best of 30, 100, 300.
    "mf-best": scenario("mf", "model-free, fewer updates", updates=100),
    "phy": scenario("phy", "Dyna-Phy"),
    "gp": scenario("gp"),
    "cka": scenario("cka"),
    "rra": scenario("rra"),
}
PAPER = ("mf", "phy", "gp", "cka", "rra")  # those that the paper compares


@dataclass(frozen=True, kw_only=True)
class Arm(Control):
    """Learners reach with an arm of six muscles, computed by OpenSim."""

    episodes: int = 30
    episode_length: int = 15
    last_model_episode: int = 30
    later_updates: int = 15
    evaluate_every: int = 3  # episodes between two evaluations; the first is before all
    map_after: int = 9  # episodes after which the errors at each target are kept
    strength: float = 0.5  # of the muscles; a healthy arm's is 1

    axes: ClassVar[Axes] = {"scenario": {name: each.label for name, each in SCENARIOS.items()}}
    packages: ClassVar[tuple[str, ...]] = (*Control.packages, "opensim")
    cheap: ClassVar[Mapping[str, Any]] = {"episodes": 2, "evaluate_every": 1000}
    curves: ClassVar[tuple[str, ...]] = PAPER
    quick: ClassVar[Mapping[str, Any]] = {
        "episodes": 12, "model_episodes": 10, "evaluate_every": 4, "map_after": 4,
    }  # fmt: skip
    known: ClassVar[Mapping[str, Scenario]] = SCENARIOS
    rmses: ClassVar[Mapping[str, str]] = {
        "theta_s": "theta_s, rad",
        "theta_e": "theta_e, rad",
        "theta_s_dot": "theta_s', rad/s",
        "theta_e_dot": "theta_e', rad/s",
    }

    def check(self) -> None:
        """Refuse a machine without OpenSim."""
        from paper.arm.system.opensim import load_opensim

        load_opensim()

    def setup(self, name: str, seed: int) -> Setup:
        """Return the arm; nothing in f_p is random."""
        from paper.arm.evaluation import setup

        return setup(self.known[name], self.settings_of(name))
