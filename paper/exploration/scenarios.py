"""The learners that are compared: two models, and who chooses the real trials."""

from __future__ import annotations

from dataclasses import replace

from gpadjust.dynamics import CKADynamics, Dynamics, GPDynamics
from gpadjust.envs import CART_POLE_SPEC
from gpadjust.physics import ODEPhysics
from gpadjust.rl import InformativeTrials
from paper.cartpole import scenarios as cartpole
from paper.cartpole.scenarios import CartPoleScenario

NUM_TRIALS = 15
SETTINGS = replace(
    cartpole.SETTINGS, num_trials=NUM_TRIALS, model_until=NUM_TRIALS, model_updates=1
)
FEW = 3  # trials after the first
RANDOM = InformativeTrials(num_random=1, num_policy=0, num_functions=1, rounds=0)
INFORMATIVE = InformativeTrials()


def _cka(physics: ODEPhysics) -> Dynamics:
    return CKADynamics(CART_POLE_SPEC, physics)


def _gp(physics: ODEPhysics) -> Dynamics:
    return GPDynamics(CART_POLE_SPEC)


MODELS = {"cka": ("Dyna-CKA", _cka), "gp": ("Dyna-GP", _gp)}
EXPLORERS: dict[str, tuple[str, InformativeTrials | None, int]] = {
    "random": ("random trials", RANDOM, NUM_TRIALS - 1),
    "sac": ("SAC's trials", None, 0),
    "info": ("informative trials", INFORMATIVE, NUM_TRIALS - 1),
    "info-3": ("3 informative trials, then SAC's", INFORMATIVE, FEW),
}
REFERENCE = "sac"
"""The explorer that the others are compared with, seed by seed and model by model."""

SCENARIOS = {
    f"{model}-{explorer}": CartPoleScenario(
        f"{model_label}, {label}", dynamics, exploration=exploration, explore_trials=trials
    )
    for model, (model_label, dynamics) in MODELS.items()
    for explorer, (label, exploration, trials) in EXPLORERS.items()
}


def model_of(name: str) -> str:
    """The model of a scenario."""
    return name.partition("-")[0]
