"""The cart-pole, the evaluation of a policy, and the records of episodes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust.dynamics import PhysicsDynamics
from gpadjust.physics import ODEPhysics
from gpadjust.rl import DynaSAC, ModelVecEnv
from gpadjust.systems import cart_pole
from gpadjust.systems.swing_up import (
    REAL_CART_POLE,
    START_MEAN,
    START_STD,
    cart_pole_reward,
    equation_physics,
)
from paper.cartpole import NUM_STARTS, CartPole, Scenario
from paper.cartpole.control import Recorder, Setup, dynamics


def setup(scenario: Scenario, settings: CartPole, seed: int) -> Setup:
    """Return the cart-pole, the task and the recorder of a run."""
    length, encode = settings.episode_length, settings.encode_angle
    system = cart_pole(seed, encode_angle=encode, episode_length=length)
    physics: Any = system.physics
    model = dynamics(scenario, settings, system.spec, physics, true_physics())
    recorder = CartPoleRecorder(settings, scenario.kind == "none")
    return Setup(system.make(), system.task(model), recorder)


def true_physics() -> ODEPhysics:
    """Return the true system."""
    return equation_physics(REAL_CART_POLE)


def fixed_starts(n: int) -> Tensor:
    """Return the first ``n`` start states of the evaluation, from a generator of their own."""
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(NUM_STARTS, 4, generator=generator, dtype=torch.float64)
    return (torch.tensor(START_MEAN, dtype=torch.float64) + START_STD * noise)[:n]


def evaluate(agent: DynaSAC, settings: CartPole) -> float:
    """Return the mean cost of the deterministic policy over fixed starts; draw no numbers."""
    system = cart_pole(encode_angle=settings.encode_angle, episode_length=settings.episode_length)
    task = replace(
        system.task(PhysicsDynamics(system.spec, true_physics())), initial_states=fixed_starts
    )
    spaces: Any = (agent.observation_space, agent.action_space)
    env = ModelVecEnv(task, NUM_STARTS, *spaces)
    observations: Any = env.reset()
    costs = []
    for _ in range(settings.episode_length):
        actions, _ = agent.predict(observations, deterministic=True)
        observations, rewards, _, _ = env.step(actions)
        costs.append(-rewards.mean())
    return float(np.mean(costs))


class CartPoleRecorder(Recorder):
    """Records the cost of each episode, and that of the deterministic policy after it."""

    def of_episode(self, states: Tensor, actions: Tensor, next_states: Tensor) -> dict[str, Any]:
        """Return the mean cost of the sampled actions."""
        return {"cost": -cart_pole_reward(states, actions, next_states).mean().item()}

    def of_policy(self, episode: int) -> dict[str, Any]:
        """Return the mean cost of the deterministic policy."""
        return {"evaluation": evaluate(self.model, self.settings)}
