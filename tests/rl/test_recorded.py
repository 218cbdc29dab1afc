"""What a buffer tells of the real episodes."""

import numpy as np
import pytest
import torch
from gymnasium import spaces

from gpadjust.dynamics import StateSpec
from gpadjust.rl import MixedReplayBuffer

SPEC = StateSpec(["x", "angle"], ["force"], angles=["angle"])
ACTIONS = spaces.Box(-4, 4, (1,))


@pytest.fixture
def recorded():
    """Records steps 0, 1, ... of episodes of so many steps; `x` is the step, plus 100 per env."""

    def record(num_steps, episode_length=3, n_envs=1, capacity=100, newest=None, terminal=False):
        buffer = MixedReplayBuffer(
            capacity * n_envs, spaces.Box(-np.inf, np.inf, (3,)), ACTIONS, "cpu", n_envs
        )
        for t in range(num_steps):
            x = t + 100.0 * np.arange(n_envs)
            obs, following = observe(x), observe(x + 0.5)
            done = (t + 1) % episode_length == 0
            infos = [{"TimeLimit.truncated": done and not terminal}] * n_envs
            buffer.add(obs, following, np.full((n_envs, 1), 0.25), -x, np.full(n_envs, done), infos)
        keep = None
        if newest is not None:
            keep = np.zeros((capacity, n_envs), dtype=bool)
            keep[buffer.pos - 1 - np.arange(min(newest, buffer.size()))] = True
        return buffer.recorded(SPEC, lambda scaled: 4 * scaled, keep)

    return record


def observe(x):
    return np.stack([x, np.sin(x), np.cos(x)], axis=-1)


def test_rows_are_states_and_actions_in_the_users_units(recorded):
    episodes = recorded(4)  # of the second episode, which goes on, there is nothing yet
    expected = torch.arange(3.0).double()
    assert episodes.states.dtype == episodes.actions.dtype == torch.float64
    assert torch.equal(episodes.states[:, 0], expected)
    angle = torch.atan2(expected.sin(), expected.cos())
    assert torch.allclose(episodes.states[:, 1], angle, atol=1e-6)
    assert torch.equal(episodes.next_states[:, 0], expected + 0.5)
    assert torch.equal(episodes.actions, torch.ones(3, 1).double())
    assert torch.equal(episodes.rewards, -expected)


def test_environments_follow_one_another(recorded):
    episodes = recorded(6, n_envs=2)
    assert episodes.states[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 100, 101, 102, 103, 104, 105]
    assert episodes.steps.tolist() == 4 * [1, 2, 3]


@pytest.mark.parametrize("n_envs", [1, 2])
def test_of_a_full_buffer_the_episode_that_lost_its_beginning_is_left_out(recorded, n_envs):
    episodes = recorded(9, n_envs=n_envs, capacity=5)  # rows 4 to 8
    assert episodes.states[:3, 0].tolist() == [6, 7, 8]
    assert len(episodes) == 3 * n_envs
    assert recorded(6, n_envs=n_envs, capacity=3).states[:3, 0].tolist() == [3, 4, 5]


@pytest.mark.parametrize(("newest", "expected"), [(2, [7, 8]), (0, []), (99, [3, 4, 5, 6, 7, 8])])
def test_the_newest_rows_alone(recorded, newest, expected):
    episodes = recorded(9, capacity=8, newest=newest)
    assert episodes.states[:, 0].tolist() == expected
