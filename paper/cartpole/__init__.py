"""Swinging up a cart-pole: learners with and without physics (the paper's sec. 3.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from paper.control import Control, Scenario
from paper.control import Settings as ControlSettings

if TYPE_CHECKING:
    from paper.control.learner import System

MODEL_FREE_UPDATES = 100  # per episode, of all episodes; the best of 25, 50, 100, 200
SUBSET = 4  # seeds of some scenarios
STALE = 3  # seeds of those without refreshed model data
NUM_STARTS = 20  # of the evaluation


@dataclass(frozen=True, kw_only=True)
class Settings(ControlSettings):
    """What decides the numbers, for all learners, unless one says otherwise."""

    episodes: int = 50
    episode_length: int = 25
    last_model_episode: int = 25
    later_updates: int = 100
    encode_angle: bool = True
    """whether policy and model see sine and cosine of the angle"""


_PAPER_GP = {"target": "absolute", "encode_angle": False}
_PAPER_RRA = {"target": "absolute"}
_STALE = {"refresh_model_data": False}
SCENARIOS = {
    "mf": Scenario("model-free"),
    "mf-best": Scenario("model-free, fewer updates", changes={"updates": MODEL_FREE_UPDATES}),
    "phy": Scenario("Dyna-Phy", "physics"),
    "gp": Scenario("Dyna-GP", "ZeroMeanGP"),
    "gp-paper": Scenario("Dyna-GP, paper", "ZeroMeanGP", _PAPER_GP),
    "cka": Scenario("Dyna-CKA", "CKA"),
    "rra": Scenario("Dyna-RRA", "RRA"),
    "rra-paper": Scenario("Dyna-RRA, paper", "PaperRRA", _PAPER_RRA),
    "oracle": Scenario("oracle", "truth"),
    "gp-absolute": Scenario("Dyna-GP, absolute", "ZeroMeanGP", {"target": "absolute"}, SUBSET),
    "cka-absolute": Scenario("Dyna-CKA, absolute", "CKA", {"target": "absolute"}, SUBSET),
    "cka-1": Scenario("Dyna-CKA, 1 update a step", "CKA", {"updates_per_model_step": 1}, SUBSET),
    "cka-4": Scenario("Dyna-CKA, 4 updates a step", "CKA", {"updates_per_model_step": 4}, SUBSET),
    "cka-stale": Scenario("Dyna-CKA, not refreshed", "CKA", _STALE, STALE),
    "gp-paper-stale": Scenario(
        "Dyna-GP, paper, not refreshed", "ZeroMeanGP", {**_PAPER_GP, **_STALE}, STALE
    ),
    "rra-paper-stale": Scenario(
        "Dyna-RRA, paper, not refreshed", "PaperRRA", {**_PAPER_RRA, **_STALE}, STALE
    ),
}
RMSES = {"x": "x, m", "theta": "theta, rad", "x_dot": "x', m/s", "theta_dot": "theta', rad/s"}


@dataclass(frozen=True, kw_only=True)
class CartPole(Control):
    """Learners swing up and balance the pole of a cart-pole."""

    out: Path = Path("results/cartpole")
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "cartpole"
    known: ClassVar[Mapping[str, Scenario]] = SCENARIOS
    rmses: ClassVar[Mapping[str, str]] = RMSES

    def system(self, name: str, seed: int) -> System:
        """The cart-pole; all learners of a seed have the same f_p."""
        from paper.cartpole.system import system

        return system(self.known[name], self.settings_of(name), seed)
