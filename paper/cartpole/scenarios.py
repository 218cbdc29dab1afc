"""The learners that are compared, and the settings that they share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from gpadjust.dynamics import (
    CKADynamics,
    Dynamics,
    GPDynamics,
    PhysicsDynamics,
    RRADynamics,
)
from gpadjust.envs import (
    CART_POLE_RAW_SPEC,
    CART_POLE_SPEC,
    CartPoleSwingUpEnv,
    cart_pole_physics,
    cart_pole_reward,
    cart_pole_start,
    random_cart_pole_physics,
)
from gpadjust.envs.cart_pole import REAL_CART_POLE
from gpadjust.physics import ODEPhysics
from paper.control.experiment import Env
from paper.control.scenario import Scenario, Settings

SETTINGS = Settings(
    num_trials=50,
    trial_length=25,
    model_until=25,
    later_updates=100,
)
MODEL_FREE_UPDATES = 100  # per trial, of all trials; the best of 25, 50, 100, 200
SUBSET = 4  # seeds of some scenarios


@dataclass(frozen=True)
class CartPoleScenario(Scenario):
    """A learner; ``encode_angle`` says whether its policy sees sine and cosine of the angle."""

    encode_angle: bool = True


def _cka(physics: ODEPhysics) -> Dynamics:
    return CKADynamics(CART_POLE_SPEC, physics)


SCENARIOS = {
    "mf": CartPoleScenario("model-free", None),
    "mf-best": CartPoleScenario("model-free, fewer updates", None, updates=MODEL_FREE_UPDATES),
    "phy": CartPoleScenario("Dyna-Phy", lambda f_p: PhysicsDynamics(CART_POLE_SPEC, f_p)),
    "gp": CartPoleScenario("Dyna-GP", lambda f_p: GPDynamics(CART_POLE_SPEC)),
    "gp-paper": CartPoleScenario(
        "Dyna-GP, paper",
        lambda f_p: GPDynamics(CART_POLE_RAW_SPEC, target="absolute"),
        encode_angle=False,
    ),
    "cka": CartPoleScenario("Dyna-CKA", _cka),
    "rra": CartPoleScenario("Dyna-RRA", lambda f_p: RRADynamics(CART_POLE_SPEC, f_p)),
    "rra-paper": CartPoleScenario(
        "Dyna-RRA, paper",
        lambda f_p: RRADynamics(CART_POLE_SPEC, f_p, prior="paper", target="absolute"),
    ),
    "oracle": CartPoleScenario("oracle", lambda f_p: true_dynamics(encode_angle=True)),
    "gp-absolute": CartPoleScenario(
        "Dyna-GP, absolute",
        lambda f_p: GPDynamics(CART_POLE_SPEC, target="absolute"),
        max_runs=SUBSET,
    ),
    "cka-absolute": CartPoleScenario(
        "Dyna-CKA, absolute",
        lambda f_p: CKADynamics(CART_POLE_SPEC, f_p, target="absolute"),
        max_runs=SUBSET,
    ),
    "cka-1": CartPoleScenario("Dyna-CKA, 1 update a step", _cka, model_updates=1, max_runs=SUBSET),
    "cka-4": CartPoleScenario("Dyna-CKA, 4 updates a step", _cka, model_updates=4, max_runs=SUBSET),
}


def true_dynamics(encode_angle: bool) -> PhysicsDynamics:
    """The system as it is, as a policy with or without the encoded angle sees it."""
    real = REAL_CART_POLE
    physics = cart_pole_physics(real.cart_mass, real.pole_mass, real.pole_length, real.damping)
    return PhysicsDynamics(CART_POLE_SPEC if encode_angle else CART_POLE_RAW_SPEC, physics)


def make_env(scenario: CartPoleScenario, settings: Settings) -> Env:
    """The real system; an environment that can be pickled."""
    return gym.wrappers.TimeLimit(
        CartPoleSwingUpEnv(encode_angle=scenario.encode_angle), settings.trial_length
    )


def make_dynamics(scenario: CartPoleScenario, seed: int, settings: Settings = SETTINGS) -> Dynamics:
    """The model. All scenarios of a seed have the same f_p; a model-free one does not use it."""
    physics = random_cart_pole_physics(seed)
    if scenario.dynamics is None:
        return PhysicsDynamics(CART_POLE_SPEC, physics)
    return scenario.dynamics(physics)


def functions(scenario: CartPoleScenario) -> dict[str, Any]:
    """The known functions, which checkpoints do not hold."""
    return {"reward": cart_pole_reward, "initial_states": cart_pole_start}
