"""The learners that are compared, and the settings that they share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

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
from gpadjust.rl import DynaSAC

Env = gym.Env[np.ndarray, np.ndarray]
MakeDynamics = Callable[[ODEPhysics], Dynamics]


@dataclass(frozen=True)
class Settings:
    """What is the same in every scenario, unless it says otherwise."""

    num_trials: int = 50
    trial_length: int = 25
    model_trials: int = 20  # after each of the first model_until trials
    model_until: int = 25
    model_updates: float = 2  # gradient steps for each step in the model
    num_particles: int = 5
    later_updates: int = 100  # gradient steps after each trial after model_until
    learning_rate: float = 3e-3
    gamma: float = 0.95
    tau: float = 0.02
    batch_size: int = 256
    net_arch: tuple[int, ...] = (128, 128)
    ent_coef: str = "auto_0.3"
    target_entropy: str | float = "auto"

    def matched_updates(self) -> int:
        """The updates that a scenario with a model makes after each trial until model_until."""
        steps = self.trial_length
        return round(steps + self.model_updates * self.model_trials * steps)


SETTINGS = Settings()
MODEL_FREE_UPDATES = 500  # per trial: what serves a model-free learner best
SUBSET = 5  # seeds of the scenarios that are beside the point


@dataclass(frozen=True)
class Scenario:
    """A learner.

    Args:
        label: Its name in tables and figures.
        dynamics: Makes the model, given f_p; None for a model-free learner.
        encode_angle: Whether the policy sees sine and cosine of the angle.
        model_updates: In place of the shared number.
        updates: Of a model-free learner, the gradient steps after each of all trials. Default:
            as many as the others make.
        max_runs: The most seeds that it is run with.
    """

    label: str
    dynamics: MakeDynamics | None
    encode_angle: bool = True
    model_updates: float | None = None
    updates: int | None = None
    max_runs: int | None = None


def _oracle(physics: ODEPhysics) -> Dynamics:
    return true_dynamics(encode_angle=True)


def _cka(physics: ODEPhysics) -> Dynamics:
    return CKADynamics(CART_POLE_SPEC, physics)


SCENARIOS = {
    "mf": Scenario("model-free", None),
    "mf-best": Scenario("model-free, best", None, updates=MODEL_FREE_UPDATES),
    "phy": Scenario("Dyna-Phy", lambda f_p: PhysicsDynamics(CART_POLE_SPEC, f_p)),
    "gp": Scenario("Dyna-GP", lambda f_p: GPDynamics(CART_POLE_SPEC)),
    "gp-paper": Scenario(
        "Dyna-GP, paper",
        lambda f_p: GPDynamics(CART_POLE_RAW_SPEC, target="absolute"),
        encode_angle=False,
    ),
    "cka": Scenario("Dyna-CKA", _cka),
    "rra": Scenario("Dyna-RRA", lambda f_p: RRADynamics(CART_POLE_SPEC, f_p)),
    "rra-paper": Scenario(
        "Dyna-RRA, paper",
        lambda f_p: RRADynamics(CART_POLE_SPEC, f_p, prior="paper", target="absolute"),
    ),
    "oracle": Scenario("oracle", _oracle),
    "gp-absolute": Scenario(
        "Dyna-GP, absolute",
        lambda f_p: GPDynamics(CART_POLE_SPEC, target="absolute"),
        max_runs=SUBSET,
    ),
    "cka-absolute": Scenario(
        "Dyna-CKA, absolute",
        lambda f_p: CKADynamics(CART_POLE_SPEC, f_p, target="absolute"),
        max_runs=SUBSET,
    ),
    "cka-1": Scenario("Dyna-CKA, 1 update a step", _cka, model_updates=1, max_runs=SUBSET),
    "cka-4": Scenario("Dyna-CKA, 4 updates a step", _cka, model_updates=4, max_runs=SUBSET),
    "oracle-4": Scenario("oracle, 4 updates a step", _oracle, model_updates=4, max_runs=SUBSET),
}


def true_dynamics(encode_angle: bool) -> PhysicsDynamics:
    """The system as it is, as a policy with or without the encoded angle sees it."""
    real = REAL_CART_POLE
    physics = cart_pole_physics(real.cart_mass, real.pole_mass, real.pole_length, real.damping)
    return PhysicsDynamics(CART_POLE_SPEC if encode_angle else CART_POLE_RAW_SPEC, physics)


def make_env(scenario: Scenario) -> Env:
    """The real system; an environment that can be pickled."""
    return gym.wrappers.TimeLimit(
        CartPoleSwingUpEnv(encode_angle=scenario.encode_angle), SETTINGS.trial_length
    )


def make_dynamics(scenario: Scenario, seed: int) -> Dynamics:
    """The model. All scenarios of a seed have the same f_p; a model-free one does not use it."""
    physics = random_cart_pole_physics(seed)
    if scenario.dynamics is None:
        return PhysicsDynamics(CART_POLE_SPEC, physics)
    return scenario.dynamics(physics)


def functions() -> dict[str, Any]:
    """The known functions, which checkpoints do not hold."""
    return {"reward": cart_pole_reward, "initial_states": cart_pole_start}


def make_agent(scenario: Scenario, seed: int, settings: Settings) -> DynaSAC:
    """The learner, at its start."""
    chosen = scenario.model_updates
    return DynaSAC(
        "MlpPolicy",
        make_env(scenario),
        dynamics=make_dynamics(scenario, seed),
        **functions(),
        model_trials=settings.model_trials,
        model_updates=settings.model_updates if chosen is None else chosen,
        model_until=0 if scenario.dynamics is None else settings.model_until,
        trial_length=settings.trial_length,
        num_particles=settings.num_particles,
        learning_rate=settings.learning_rate,
        gamma=settings.gamma,
        tau=settings.tau,
        batch_size=settings.batch_size,
        ent_coef=settings.ent_coef,
        target_entropy=settings.target_entropy,
        policy_kwargs={
            "net_arch": list(settings.net_arch),
            "optimizer_kwargs": {"fused": True},
        },
        device="cpu",
        seed=seed,
    )


def updates_on_trial(scenario: Scenario, settings: Settings, trial: int) -> int:
    """Gradient steps after this real trial (from 1), without those within the model."""
    if scenario.dynamics is None and scenario.updates is not None:
        return scenario.updates
    if trial > settings.model_until:
        return settings.later_updates
    if scenario.dynamics is None:
        return settings.matched_updates()
    return settings.trial_length
