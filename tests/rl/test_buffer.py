"""Real and model experience in one buffer."""

import copy
import pickle

import numpy as np
import pytest
import torch
from gymnasium import spaces

from gpadjust.rl import MixedReplayBuffer
from tests.point import assert_equal
from tests.rl.conftest import COLUMNS
from tests.systems import same

OBSERVATIONS = spaces.Box(-np.inf, np.inf, (2,))
ACTIONS = spaces.Box(-1, 1, (1,))


@pytest.fixture
def buffer():
    """Makes a buffer with so many rows; real rewards are 1, 2, ..., those of the model -1, ..."""

    def make(num_real=0, num_model=0, buffer_size=50, n_envs=1, **options):
        made = MixedReplayBuffer(buffer_size, OBSERVATIONS, ACTIONS, "cpu", n_envs, **options)
        for i in range(1, num_real + 1):
            made.add(*real_row(i, n_envs))
        if num_model:
            made.add_model_rows(*rows(np.arange(-1, -num_model - 1, -1)))
        return made

    return make


def real_row(i, n_envs=1):
    obs = np.full((n_envs, 2), i)
    return obs, obs + 0.5, obs[:, :1] / 100, np.full(n_envs, i), np.zeros(n_envs), [{}] * n_envs


def rows(values):
    obs = np.repeat(values[:, None], 2, axis=1)
    none = np.zeros(len(values), dtype=bool)
    return obs, obs + 0.5, obs[:, :1] / 100, values, none, none


@pytest.mark.parametrize(("batch_size", "fraction"), [(11, 1 / 11), (3, 0.5), (8, 0.1), (16, 1.0)])
def test_batches_hold_the_promised_share(buffer, batch_size, fraction):
    np.random.seed(0)  # noqa: NPY002 - the generator that SB3 uses
    made = buffer(20, 20, n_envs=2, real_fraction=fraction)
    counts = [int((made.sample(batch_size).rewards > 0).sum()) for _ in range(400)]
    expected = batch_size * fraction
    assert set(counts) == {int(np.floor(expected)), int(np.ceil(expected))}
    part = expected % 1
    assert abs(np.mean(counts) - expected) <= 4 * np.sqrt(part * (1 - part) / 400)


def test_a_sample_is_a_whole_row(buffer):
    batch = buffer(20, 20, real_fraction=0.5).sample(32)
    obs = batch.rewards.expand(-1, 2)
    found = batch.observations, batch.next_observations, batch.actions
    same(found, (obs, obs + 0.5, batch.rewards / 100), rtol=1e-6, atol=0)


def test_one_buffer_serves_where_the_other_does_not(buffer):
    for num_real, num_model, mix, sign in (
        (5, 0, True, 1),
        (0, 5, True, -1),
        (5, 5, False, 1),
        (5, 0, False, 1),
    ):
        made = buffer(num_real, num_model, real_fraction=0.5)
        made.mix = mix
        assert (made.sample(16).rewards * sign > 0).all()


def test_terminations_by_the_time_limit_are_not_dones(buffer):
    made = buffer()
    dones, timeouts = np.array([0, 1, 1], dtype=bool), np.array([0, 0, 1], dtype=bool)
    made.add_model_rows(*rows(np.arange(1, 4))[:4], dones, timeouts)
    batch = made.sample(64)
    np.testing.assert_array_equal(batch.dones, batch.rewards == 2)


@pytest.mark.parametrize("chunks", [[3, 4], [7, 2, 5], [4, 10], [3, 23], [0, 2]])
def test_add_rows_keeps_the_newest_rows_in_order(buffer, chunks):
    mixed, one, end = buffer(buffer_size=10), buffer(buffer_size=10), 1
    for size in chunks:
        mixed.add_model_rows(*rows(np.arange(end, end + size)))
        end += size
    one.extend(*zip(*map(real_row, range(1, end)), strict=True))

    def in_order(buffer):
        first = buffer.pos if buffer.full else 0
        places = (first + np.arange(buffer.size())) % buffer.buffer_size
        return [getattr(buffer, name)[places, 0].tolist() for name in COLUMNS]

    assert mixed.model_buffer.size() == one.size()
    assert in_order(mixed.model_buffer) == in_order(one)
    one.add_model_rows(*rows(np.arange(3)))
    one.reset()
    assert one.size() == one.model_buffer.size() == len(one.episodes) == 0


@pytest.mark.parametrize("num_rows", [0, 4, 70])
def test_a_copy_goes_on_as_the_buffer_would(buffer, num_rows):
    made = buffer(num_rows, num_rows, real_fraction=0.3)
    content = []
    for side in (made, copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        side.add(*real_row(99))
        side.add_model_rows(*rows(np.array([-98, -99])))
        np.random.seed(1)  # noqa: NPY002
        parts = [(each.pos, each.full, each.observations) for each in (side, side.model_buffer)]
        content.append([*side.sample(40)[:-1], parts])
    assert_equal(content[1:], content[:1] * 2)


def test_samples_are_normalised(buffer, normalised):
    normalizer, batches = normalised(), []
    normalizer.observation_space = OBSERVATIONS
    normalizer.obs_rms.mean, normalizer.obs_rms.var = np.array([1.0, 2.0]), np.array([4.0, 4.0])
    normalizer.ret_rms.var = np.array(100.0)
    made = buffer(5, 5, real_fraction=0.5)
    for given in (None, normalizer):
        np.random.seed(2)  # noqa: NPY002
        batches.append(made.sample(20, given))
    plain, batch = batches
    for name in ("observations", "next_observations"):
        expected = (getattr(plain, name) - np.array([1.0, 2.0])) / 2
        np.testing.assert_allclose(getattr(batch, name), expected, rtol=1e-4)
    np.testing.assert_allclose(batch.rewards, plain.rewards / 10, rtol=1e-4)


# Real episodes


def played(num_steps, n_envs=1, failing=()):
    """A buffer of steps 0, 1, ... (plus 100 in the second environment) in episodes of three."""
    wide = spaces.Box(-4, 4, (1,))
    made = MixedReplayBuffer(5 * n_envs, OBSERVATIONS, wide, "cpu", n_envs)
    for t in range(num_steps):
        obs = np.stack([t + 100.0 * np.arange(n_envs), np.zeros(n_envs)], -1)
        ends = np.full(n_envs, (t + 1) % 3 == 0)
        infos = [
            {"TimeLimit.truncated": t == 2, "step_failed": (t, i) in failing} for i in range(n_envs)
        ]
        made.add(obs, obs + 0.5, np.full((n_envs, 1), 0.25), -obs[:, 0], ends, infos)
    return made


def test_episodes_that_have_ended_are_in_the_users_units():
    """Also of steps that the learner has forgotten, as there is room for five."""
    made = played(8)
    found = made.episodes  # of the third episode, which goes on, there is nothing yet
    assert found.states.dtype == found.actions.dtype == torch.float64
    assert found.states[:, 0].tolist() == found.rewards.neg().tolist() == [0, 1, 2, 3, 4, 5]
    assert torch.equal(found.next_states, found.states + 0.5)
    assert torch.equal(found.actions, torch.ones(6, 1).double())
    assert found.steps.tolist() == 2 * [1, 2, 3]
    assert found.terminated.tolist() == 5 * [False] + [True]
    made.end_episodes()
    assert made.episodes.states[6:, 0].tolist() == [6, 7]


def test_episodes_of_several_environments_are_apart_and_end_where_a_step_failed():
    found = played(4, 2, failing=[(1, 0), (3, 1)]).episodes
    assert [part.states[:, 0].tolist() for part in found.episodes()] == [[0], [2], [100, 101, 102]]
