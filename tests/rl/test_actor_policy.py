"""Actors of Stable-Baselines3 that a policy search improves."""

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from gpadjust.control import PolicySearch, Task
from gpadjust.dynamics import PhysicsDynamics, StateSpec
from gpadjust.rl import actor_policy

SPEC = StateSpec(["x"], ["v"])


class Point(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 2.0, (1,), np.float32)


@pytest.mark.parametrize("algorithm", [SAC, TD3])
def test_an_actor_is_improved_in_place(algorithm):
    agent = algorithm("MlpPolicy", Point(), policy_kwargs={"net_arch": [16]}, seed=0)
    policy = actor_policy(agent, SPEC)
    x = torch.linspace(-2, 2, 9, dtype=torch.float64).unsqueeze(-1)

    def same():
        actions, _ = agent.predict(x.float().numpy(), deterministic=True)
        np.testing.assert_allclose(actions, policy(x).detach().numpy(), atol=1e-5)
        return actions

    before = same()
    task = Task(
        PhysicsDynamics(SPEC, lambda X: X[:, :1] + 0.5 * X[:, 1:]),
        lambda states, actions, next_states: -next_states[:, 0].square(),
        initial_states=lambda n: torch.randn(n, 1, dtype=torch.float64),
        episode_length=3,
    )
    values = PolicySearch(updates=40, learning_rate=0.03).improve(policy, task).values
    assert values[-5:].mean() > values[:5].mean()
    assert np.abs(same() - before).max() > 0.1


@pytest.mark.parametrize(
    ("make", "spec", "error", "message"),
    [
        (lambda: DQN("MlpPolicy", "CartPole-v1"), SPEC, TypeError, "such as SAC or TD3, found DQN"),
        (
            lambda: SAC("MlpPolicy", Point()),
            StateSpec(["x", "y"], ["v"]),
            ValueError,
            r"shapes \(\(2,\), \(1,\)\), those of the spec; found \(\(1,\), \(1,\)\)",
        ),
        (
            lambda: SAC("MlpPolicy", VecNormalize(DummyVecEnv([Point]))),
            SPEC,
            ValueError,
            "normalises observations",
        ),
    ],
)
def test_agents_without_such_an_actor_are_refused(make, spec, error, message):
    with pytest.raises(error, match=message):
        actor_policy(make(), spec)
