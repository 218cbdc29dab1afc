"""What is written down of each trial."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpadjust.envs import cart_pole_reward
from gpadjust.envs.cart_pole import START_MEAN, START_STD
from gpadjust.rl import DynaSAC, ModelVecEnv
from paper.cartpole.scenarios import CartPoleScenario, true_dynamics
from paper.control.recorder import Recorder

NUM_STARTS = 20


def fixed_starts(n: int) -> Tensor:
    """The first ``n`` start states of the evaluation, from a generator of their own."""
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(NUM_STARTS, 4, generator=generator, dtype=torch.float64)
    return (torch.tensor(START_MEAN, dtype=torch.float64) + START_STD * noise)[:n]


def evaluate(agent: DynaSAC, encode_angle: bool, trial_length: int) -> float:
    """The mean cost of the deterministic policy over the fixed starts; draws no random number."""
    env = ModelVecEnv(
        true_dynamics(encode_angle),
        cart_pole_reward,
        fixed_starts,
        NUM_STARTS,
        trial_length,
        agent.observation_space,
        agent.action_space,
    )
    observations: Any = env.reset()
    costs = []
    for _ in range(trial_length):
        actions, _ = agent.predict(observations, deterministic=True)
        observations, rewards, _, _ = env.step(actions)
        costs.append(-rewards.mean())
    return float(np.mean(costs))


class CartPoleRecorder(Recorder):
    """Records the cost of each trial, and that of the deterministic policy after it."""

    scenario: CartPoleScenario

    def of_trial(self, states: Tensor, actions: Tensor, next_states: Tensor) -> dict[str, Any]:
        """The mean cost of the sampled actions."""
        return {"cost": -cart_pole_reward(states, actions, next_states).mean().item()}

    def of_policy(self, trial: int) -> dict[str, Any]:
        """The mean cost of the deterministic policy."""
        encode_angle, length = self.scenario.encode_angle, self.settings.trial_length
        return {"evaluation": evaluate(self.model, encode_angle, length)}
