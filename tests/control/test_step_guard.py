"""Steps that fail: refused with a sentence, and learning goes on."""

import numpy as np
import pytest
import torch

from gpadjust.control import FailedStepWarning, MPCAgent, StepGuard
from tests.point import FAULTS, Faulty

pytestmark = pytest.mark.filterwarnings("ignore:A step of the last real episode")
ACTION = np.ones(1, dtype=np.float32)
SAID = {
    "nan": "entry 0 of the observation is nan",
    "inf": "entry 0 of the observation is inf",
    "1e30": r"entry 0 of the observation is 1e\+30, where a finite number of at most 1e\+25",
    "reward nan": "the reward is nan",
    "reward 1e30": r"the reward is 1e\+30",
    "raises": "the environment raised OSError: the robot fell",
}


@pytest.mark.parametrize("fault", SAID)
@pytest.mark.parametrize("place", [1, 3])
def test_a_step_that_fails_ends_its_episode_at_the_last_good_observation(point_env, fault, place):
    """Though the environment writes over its observations."""

    class Reuses(Faulty):
        def step(self, action):
            found = super().step(action)
            self.unwrapped.x[:] = found[0]
            return found

    env = StepGuard(Reuses(point_env(), {place: fault}))
    last = env.reset(seed=0)[0].copy()
    for _ in range(place - 1):
        last = env.step(ACTION)[0].copy()
    with pytest.warns(FailedStepWarning, match=f"Step {place} of an episode failed.*{SAID[fault]}"):
        observation, *others = env.step(ACTION)
    assert np.array_equal(observation, last)
    assert others == [0.0, False, True, {"step_failed": True}]
    env.reset()
    assert "step_failed" not in env.step(ACTION)[4]


def test_good_steps_are_as_without_a_guard(point_env):
    """In units small and large."""
    guarded, plain = StepGuard(point_env()), point_env()
    for env in (guarded, plain):
        env.reset(seed=1)
        env.unwrapped.x = np.array([1e12], dtype=np.float32)
    for action in (1e-9, 2.0):
        one, other = (env.step(np.array([action])) for env in (guarded, plain))
        assert one == other
    assert StepGuard.around(guarded) is guarded


@pytest.mark.filterwarnings("ignore::gpadjust.control.FailedStepWarning")
def test_an_environment_that_can_make_no_step_is_an_error_in_the_third_episode(point_env):
    env = StepGuard(Faulty(point_env(), dict.fromkeys((2, 3, 4, 5), "raises")))
    env.reset()
    for _ in range(2):  # an episode with a step
        env.step(ACTION)
    for _ in range(2):
        env.reset()
        env.step(ACTION)
    env.reset()
    with pytest.raises(RuntimeError, match="The 2 previous episodes had no valid step") as found:
        env.step(ACTION)
    assert isinstance(found.value.__cause__, OSError)


def test_an_interruption_comes_through(point_env):
    class Interrupted(Faulty):
        def step(self, action):
            raise KeyboardInterrupt

    env = StepGuard(Interrupted(point_env(), {}))
    env.reset()
    with pytest.raises(KeyboardInterrupt):
        env.step(ACTION)


def test_an_episode_that_cannot_begin_is_an_error(make_agent, point_env):
    class Blind(Faulty):
        def reset(self, **options):
            observation, info = super().reset(**options)
            return observation * (np.nan if self.steps == 5 else 1.0), info

    agent = make_agent(MPCAgent, Blind(point_env(), {}))
    with pytest.raises(ValueError, match="An episode cannot begin: entry 0 of the observation is"):
        agent.learn(10)
    agent.env.env.steps = 0
    assert len(agent.learn(5).recorded_episodes()) == 10


@pytest.mark.slow
def test_agents_lose_nothing(make_agent, kind, point_env):
    """Of the first, a middle and the last step; before there are data, and after."""
    agent = make_agent(kind, Faulty(point_env(), FAULTS))
    with pytest.warns(FailedStepWarning) as told:
        agent.learn(max(FAULTS))
    assert len([each for each in told if each.category is FailedStepWarning]) == len(FAULTS)
    recorded = agent.learn(5).recorded_episodes()
    assert len(recorded) == agent.num_timesteps - len(FAULTS)
    assert agent.task.dynamics.num_transitions == len(recorded)
    moved = recorded.next_states - recorded.states
    torch.testing.assert_close(moved, 0.5 * recorded.actions, atol=0.1, rtol=0)
    assert recorded.rewards.isfinite().all()
    assert agent.num_episodes == int((recorded.steps == 1).sum())


@pytest.mark.parametrize("seen", [np.array([np.nan]), np.array([[0.5], [np.inf]])])
def test_an_observation_that_cannot_be_data_is_not_acted_on(make_agent, kind, seen):
    with pytest.raises(ValueError, match=r"No action can be chosen: entry .* of the observ"):
        make_agent(kind).predict(seen)
