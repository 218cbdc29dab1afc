"""Errors on the way lose nothing."""

from contextlib import suppress

import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from gpadjust.control import FailedStepWarning
from gpadjust.physics import PhysicsError
from gpadjust.rl import ModelVecEnv
from tests.point import FAULTS, Faulty, assert_equal
from tests.rl.conftest import model_rows


def test_a_wrong_reward_is_mended_and_nothing_is_lost(point_agent, point_task, learnt_dynamics):
    dynamics = learnt_dynamics()
    agent = point_agent(dynamics=dynamics, reward=lambda states, *_: states[:, 0])
    before = [p.clone() for p in agent.policy.parameters()]
    with pytest.raises(ValueError, match="is not the environment's"):
        agent.learn(5)
    assert model_rows(agent) == 0
    assert_equal([*agent.policy.parameters()], before)
    agent.task = point_task(dynamics=dynamics)
    agent.learn(5, reset_num_timesteps=False)
    learnt = dynamics.state_dict()["transitions"]["states"]
    assert torch.equal(learnt, agent.recorded_episodes().states)
    assert agent.num_episodes == 2
    assert model_rows(agent) == 2 * 2 * 5


def assert_moved(recorded):
    """Asserts that each step is one of the point, none across an episode's end."""
    moved = recorded.next_states - recorded.states
    torch.testing.assert_close(moved, 0.5 * recorded.actions, atol=0.1, rtol=0)


@pytest.mark.parametrize("fails", ["fit", "rollout"])
def test_a_physics_that_fails_for_a_while_loses_no_transition(
    point_agent, point_task, crude_dynamics, fails, monkeypatch
):
    """Where the dynamics learn, or after that, where particles move."""
    broken = []

    def physics(X):
        if broken:
            raise PhysicsError("the simulator's licence has expired")
        return X[:, :1] + 0.4 * X[:, 1:]

    def breaks(local_names, global_names):
        broken.extend([1] * (agent.num_timesteps == 8))
        return True

    dynamics = crude_dynamics(physics)
    agent = point_agent(dynamics=dynamics).learn(5)
    if fails == "rollout":
        monkeypatch.setattr(ModelVecEnv, "reset", lambda env: broken.append(1) or env._states)
    with pytest.raises(PhysicsError, match="licence"):
        agent.learn(5, breaks if fails == "fit" else None, reset_num_timesteps=False)
    assert dynamics.num_transitions == (5 if fails == "fit" else 10)
    broken.clear()
    monkeypatch.undo()
    for given in (dynamics, crude_dynamics(physics)):  # others learn all that there is
        agent.task = point_task(dynamics=given)
        agent.learn(5, reset_num_timesteps=False)
        learnt = given.state_dict()["transitions"]["states"]
        assert torch.equal(learnt, agent.recorded_episodes().states)
    assert agent.num_episodes == 4


@pytest.mark.parametrize("layers", [(), ("normalised",)])
def test_steps_that_fail_end_their_episodes_and_lose_nothing(
    point_agent, point_env, learnt_dynamics, layers
):
    env = Faulty(point_env(), FAULTS)
    env = VecNormalize(DummyVecEnv([lambda: env])) if layers else env
    agent = point_agent(env, dynamics=learnt_dynamics())
    with pytest.warns(FailedStepWarning) as told:
        agent.learn(max(FAULTS))
    assert len(told) == len(FAULTS)
    agent.learn(10, reset_num_timesteps=False)
    recorded = agent.recorded_episodes()
    assert agent.task.dynamics.num_transitions == len(recorded) == 28 - len(FAULTS)
    assert_moved(recorded)
    assert (recorded.steps == 1).sum() == 6
    for group in (*agent.get_parameters()["policy"].values(), recorded.rewards):
        assert group.isfinite().all()
    if layers:
        assert abs(agent.env.obs_rms.mean).max() < 10


def test_a_vectorised_environment_without_guards_gives_no_bad_data(point_agent, point_env):
    """As where other processes run the environments: a bad observation is refused."""
    env = DummyVecEnv([lambda: Faulty(point_env(), {8: "nan", 12: "reward inf"})])
    agent = point_agent(env)
    env.envs = [env.envs[0].env]
    for _ in range(2):
        with suppress(ValueError):
            agent.learn(10, reset_num_timesteps=False)
    assert agent.replay_buffer.size() == agent.num_timesteps - 2
    assert agent.recorded_episodes().rewards.isfinite().all()


@pytest.mark.filterwarnings("ignore::gpadjust.control.FailedStepWarning")
def test_of_several_environments_one_may_fail(point_agent, point_env):
    env = DummyVecEnv([lambda: Faulty(point_env(), {4: "raises"}), point_env])
    agent = point_agent(env, train_freq=(5, "step"), reward_tolerance=None).learn(20)
    recorded = agent.recorded_episodes()
    assert len(recorded) == 18  # the step after the last of these begins an episode that goes on
    assert_moved(recorded)
    assert agent.replay_buffer.size() == 10
    batch = agent.replay_buffer.sample(200)
    moved = batch.next_observations - batch.observations
    torch.testing.assert_close(moved, batch.actions, atol=0.1, rtol=0)
