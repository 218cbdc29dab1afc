"""Errors on the way lose nothing."""

from contextlib import suppress

import gymnasium
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from gpadjust.control import FailedStepWarning
from gpadjust.physics import PhysicsError
from gpadjust.rl import ModelVecEnv
from tests.point import Faulty
from tests.rl.conftest import model_rows


def test_a_wrong_reward_is_mended_and_nothing_is_lost(point_agent, point_task, learnt_dynamics):
    dynamics = learnt_dynamics()
    wrong = point_task(dynamics=dynamics, reward=lambda states, actions, following: states[:, 0])
    agent = point_agent(task=wrong)
    before = [p.clone() for p in agent.policy.parameters()]
    with pytest.raises(ValueError, match="is not the environment's"):
        agent.learn(5)
    assert model_rows(agent) == 0
    assert all(torch.equal(*pair) for pair in zip(before, agent.policy.parameters(), strict=True))
    agent.task = point_task(dynamics=dynamics)
    agent.learn(5, reset_num_timesteps=False)
    learnt = dynamics.state_dict()["transitions"]["states"]
    assert torch.equal(learnt, agent.recorded_episodes().states)
    assert agent.num_episodes == 2
    assert model_rows(agent) == 2 * 2 * 5


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

    dynamics = crude_dynamics(physics)
    agent = point_agent(dynamics=dynamics)
    agent.learn(5)
    if fails == "rollout":
        monkeypatch.setattr(ModelVecEnv, "reset", lambda env: broken.append(1) or env._states)
    breaks = None
    if fails == "fit":
        breaks = lambda local, _: broken.extend([1] * (agent.num_timesteps == 8)) or True  # noqa: E731
    with pytest.raises(PhysicsError, match="licence"):
        agent.learn(5, breaks, reset_num_timesteps=False)
    assert dynamics.num_transitions == (5 if fails == "fit" else 10)
    broken.clear()
    monkeypatch.undo()
    agent.learn(5, reset_num_timesteps=False)
    learnt = dynamics.state_dict()["transitions"]["states"]
    assert torch.equal(learnt, agent.recorded_episodes().states)
    agent.task = point_task(dynamics=crude_dynamics(physics))  # others learn all that there is
    agent.learn(5, reset_num_timesteps=False)
    learnt = agent.task.dynamics.state_dict()["transitions"]["states"]
    assert torch.equal(learnt, agent.recorded_episodes().states)
    assert agent.num_episodes == 4


FAILS = {1: "raises", 4: "nan", 9: "1e30", 12: "reward nan", 13: "reward 1e30", 18: "inf"}


@pytest.mark.parametrize("layers", [(), ("normalised",)])
def test_steps_that_fail_end_their_episodes_and_lose_nothing(
    point_agent, point_env, learnt_dynamics, layers
):
    """The first step of one, steps in the middle and at the end; good episodes follow."""
    env = Faulty(point_env(), FAILS)
    env = VecNormalize(DummyVecEnv([lambda: env])) if layers else env
    agent = point_agent(env, dynamics=learnt_dynamics())
    with pytest.warns(FailedStepWarning) as told:
        agent.learn(18)
    assert len(told) == len(FAILS)
    agent.learn(10, reset_num_timesteps=False)
    recorded = agent.recorded_episodes()
    assert agent.task.dynamics.num_transitions == len(recorded) == 28 - len(FAILS)
    moved = recorded.next_states - recorded.states
    torch.testing.assert_close(moved, 0.5 * recorded.actions, atol=0.1, rtol=0)
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


class Jams(gymnasium.Wrapper):
    """At some steps, numbered from 0, the system does not move, and says so."""

    def __init__(self, env, jams):
        super().__init__(env)
        self.jams, self.steps = jams, 0

    def step(self, action):
        before = self.env.unwrapped.x.copy()
        observation, reward, terminated, truncated, info = self.env.step(action)
        failed = self.steps in self.jams
        self.steps += 1
        if failed:
            self.env.unwrapped.x = observation = before
        return observation, reward, terminated, truncated or failed, info | {"step_failed": failed}


@pytest.mark.slow
@pytest.mark.parametrize("jams", [(0,), (5, 6)])
def test_a_step_that_failed_is_no_data(point_agent, point_env, learnt_dynamics, jams):
    dynamics = learnt_dynamics()
    agent = point_agent(Jams(point_env(), jams), dynamics=dynamics, reward_tolerance=None).learn(15)
    assert agent.replay_buffer.size() == agent.num_timesteps - len(jams)
    recorded = agent.recorded_episodes()
    moved = recorded.next_states - recorded.states
    torch.testing.assert_close(moved, 0.5 * recorded.actions, atol=0.1, rtol=0)
    follows = (recorded.states[1:] == recorded.next_states[:-1]).all(-1)
    starts = [0, *(1 + follows.logical_not().nonzero().flatten()).tolist()]
    assert (recorded.steps == 1).nonzero().flatten().tolist() == starts
    assert (recorded.episode.diff() > 0).nonzero().flatten().add(1).tolist() == starts[1:]
    assert dynamics.num_transitions <= len(recorded)


def test_of_several_environments_one_may_fail(point_agent, point_env):
    env = DummyVecEnv([lambda: Jams(point_env(), (3,)), point_env])
    agent = point_agent(env, train_freq=(5, "step"), reward_tolerance=None).learn(20)
    recorded = agent.recorded_episodes()
    assert len(recorded) == 18  # the step after the last of these begins an episode that goes on
    assert agent.replay_buffer.size() == 10
    moved = recorded.next_states - recorded.states
    torch.testing.assert_close(moved, 0.5 * recorded.actions, atol=0.1, rtol=0)
    batch = agent.replay_buffer.sample(200)
    moved = batch.next_observations - batch.observations
    torch.testing.assert_close(moved, batch.actions, atol=0.1, rtol=0)
