"""The muscle arm as a Gymnasium environment."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from paper.arm import system
from paper.arm.system import MuscleArmEnv, hand_distance_cm, hand_position
from paper.arm.system.opensim import MUSCLES, load_opensim
from paper.arm.system.reaching import ARM_MEMORY_SPEC, arm_reward
from tests.systems import refused

ROOT = Path(__file__).parents[2]
ID = "paper.arm.system:MuscleArm-v0"
START = np.radians([35.0, 65.0, 0.0, 0.0])
TARGET = np.radians([70.0, 40.0])
GENTLE = np.array([0.2, 0.1, 0.3, 0.1], dtype=np.float32)


@pytest.fixture(autouse=True)
def _no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture(scope="module")
def arm():
    """The environment, to be reset by each test."""
    return MuscleArmEnv()


def start(env):
    env.reset(seed=0, options={"state": START, "target": TARGET})
    return env


def rollout(env, num_steps=5, seed=0):
    actions = np.random.default_rng(seed).uniform(0, 1, (num_steps, 4)).astype(np.float32)
    return [env.step(action) for action in actions]


def same(transitions, others):
    pairs = zip(transitions, others, strict=True)
    return all(np.array_equal(a[0], b[0]) and a[1:] == b[1:] for a, b in pairs)


def test_golden_trajectory():
    env = start(MuscleArmEnv(strength=0.3, accuracy=1e-8))
    states = []
    for _ in range(5):
        env.step(GENTLE)
        states.append(env.state[:4])
    first, fifth = [0.6745856, 1.1299697, 0.613568, -0.0042265], [1.4363824, 1.1695989, 0.8287791]
    np.testing.assert_allclose(states[0], first, rtol=0, atol=1e-5)
    np.testing.assert_allclose(states[4], [*fifth, 0.0578116], rtol=0, atol=1e-5)


def test_default_accuracy_is_enough(arm):
    fine = MuscleArmEnv(accuracy=1e-8)
    rollout(start(arm), 15)
    rollout(start(fine), 15)
    np.testing.assert_allclose(arm.state[:2], fine.state[:2], rtol=0, atol=5e-5)


def test_activations_follow_the_excitations_and_are_hidden(arm):
    start(arm)
    assert np.array_equal(arm.activations, np.full(6, 0.01))
    arm.step(GENTLE)
    np.testing.assert_allclose(arm.activations, [0.2, 0.1, 0.3, 0.1, 0, 0], atol=1e-3)
    assert arm.observation_space.shape == (6,)


def test_fibres_are_at_their_optimum_at_the_mean_start():
    simulation = MuscleArmEnv().simulation
    model, start_state = simulation._model, simulation._start
    assert [model.getMuscles().get(i).getName() for i in range(6)] == [m.name for m in MUSCLES]
    for joint, angle in zip(("shoulder", "elbow"), START[:2], strict=True):
        model.getCoordinateSet().get(joint).setValue(start_state, angle)
    model.realizeDynamics(start_state)
    for i, muscle in enumerate(MUSCLES):
        length = model.getMuscles().get(i).getFiberLength(start_state)
        np.testing.assert_allclose(length, muscle.fibre, rtol=1e-6)
    slack = [m.length(*START[:2]) - m.fibre for m in MUSCLES]
    expected = [0.19921, 0.17302, 0.04580, 0.06340, 0.17287, 0.16803]
    np.testing.assert_allclose(slack, expected, rtol=0, atol=1e-5)


@pytest.mark.filterwarnings("ignore:.*For Box action spaces, we recommend:UserWarning")
@pytest.mark.filterwarnings("ignore:We recommend you to use a symmetric and normalized:UserWarning")
def test_gymnasium_and_stable_baselines_find_no_fault():
    check_env(gym.make(ID).unwrapped)
    sb3_check_env(gym.make(ID, render_mode="rgb_array").unwrapped)


def test_episode_is_truncated_after_15_steps():
    env = gym.make(ID)
    env.reset(seed=0)
    ends = [transition[2:4] for transition in rollout(env, 15)]
    assert ends == [(False, False)] * 14 + [(False, True)]


def test_reward_and_distance_are_those_of_the_new_state(arm):
    start(arm)
    observation, reward, _, _, info = rollout(arm)[-1]
    state = torch.from_numpy(arm.state)
    assert np.array_equal(observation, arm.state.astype(np.float32))
    assert np.array_equal(arm.state[4:], TARGET)
    assert reward == arm_reward(state, state, state).item()
    assert info == {
        "hand_distance_cm": hand_distance_cm(state).item(),
        "step_failed": False,
    }


def test_starts_and_targets_are_drawn(arm):
    arm.reset(seed=0)
    states = []
    for _ in range(2000):
        arm.reset()
        states.append(np.degrees(arm.state))
    np.testing.assert_allclose(np.mean(states, axis=0), [35, 65, 0, 0, 50, 50], atol=2)
    np.testing.assert_allclose(np.std(states, axis=0), [5, 5, 0, 0, 28.9, 28.9], atol=1)
    assert np.min(states, axis=0)[4:].min() >= 0
    assert np.max(states, axis=0)[4:].max() <= 100


def test_options_do_not_change_what_else_is_drawn(arm):
    drawn = arm.reset(seed=5)[0]
    assert np.array_equal(arm.reset(seed=5, options={"state": START})[0][4:], drawn[4:])
    assert np.array_equal(arm.reset(seed=5, options={"target": TARGET})[0][:4], drawn[:4])


def test_copy_goes_on_as_the_original():
    env = gym.make(ID, render_mode="rgb_array")
    env.reset(seed=0)
    rollout(env, 3)
    env.render()
    twin = pickle.loads(pickle.dumps(env))
    assert same(rollout(env, 3), rollout(twin, 3))
    assert np.array_equal(env.reset()[0], twin.reset()[0])
    assert np.array_equal(env.render(), twin.render())
    env.close()
    twin.close()


def test_excitations_are_clipped(arm):
    full = start(arm).step(np.array([1.0, 0.0, 1.0, 0.0]))
    beyond = start(arm).step(np.array([7.0, -3.0, 1.5, -0.1]))
    assert same([full], [beyond])


NEW = MuscleArmEnv(render_mode="rgb_array")
NEEDED = gym.error.ResetNeeded
REFUSED = [
    (lambda arm: NEW.step(GENTLE), NEEDED, "before the first step"),
    (lambda arm: NEW.render(), NEEDED, "reset"),
    (lambda arm: start(arm).step([0.1, np.inf, 0.0, 0.0]), ValueError, "four finite excitations"),
    (lambda arm: arm.reset(options={"state": [0.0, 0.0, 1e4, 0.0]}), ValueError,
     "4 numbers theta_s.* at most 6.283, 6.283, 100, 100"),
    (lambda arm: arm.reset(options={"target": [0.0] * 3}), ValueError, "2 numbers target_s"),
    (lambda arm: arm.reset(options={"start": START}), ValueError, "Unknown option 'start'"),
    (lambda arm: MuscleArmEnv(strength=2.1), ValueError, "strength"),
    (lambda arm: MuscleArmEnv(accuracy=1.0), ValueError, "accuracy"),
]  # fmt: skip


def test_refused(arm):
    for call, error, words in REFUSED:
        refused(error, words, call, arm)


@pytest.mark.parametrize("speed", [1e3, 1e9])
def test_failed_integration_truncates_and_reset_recovers(arm, speed):
    expected = rollout(start(arm))
    arm.state[2] = speed  # far beyond what the start may have
    before = arm.state.astype(np.float32)
    with pytest.warns(UserWarning, match="failed to integrate the arm from .* reset starts"):
        observation, reward, terminated, truncated, info = arm.step(GENTLE)
    assert truncated
    assert not terminated
    assert info["step_failed"] is True
    assert np.isfinite(reward)
    assert np.array_equal(observation, before)
    with pytest.raises(gym.error.ResetNeeded, match="after a failed integration"):
        arm.step(GENTLE)
    assert same(rollout(start(arm)), expected)


@pytest.mark.slow
def test_random_trials_do_not_fail(arm):
    arm.reset(seed=0)
    rng = np.random.default_rng(0)
    for trial in range(24):
        arm.reset()
        for _ in range(15):
            # Every second trial switches the muscles fully on and off.
            action = rng.uniform(size=4)
            observation, _, _, truncated, _ = arm.step(action.round() if trial % 2 else action)
            assert not truncated
            assert arm.observation_space.contains(observation)


GREEN, LIGHT = (44, 140, 68), (215, 215, 215)


def test_frame_shows_the_target_where_it_is():
    """The frame is 480 x 400 pixels, 320 of them a metre, with the shoulder at (240, 248)."""
    env = MuscleArmEnv(render_mode="rgb_array")
    for target in ((1.2, 0.4), (0.2, 0.3)):
        env.reset(options={"state": START, "target": target})
        frame = env.render()
        assert (frame.shape, frame.dtype) == ((400, 480, 3), np.uint8)
        rows, columns = (np.abs(frame.astype(int) - GREEN).sum(-1) < 40).nonzero()
        green = np.stack([columns - 240, 248 - rows], -1)  # of the target and the hand
        places = [320 * hand_position(torch.tensor(at)).numpy() for at in (target, START[:2])]
        far = np.stack([np.linalg.norm(green - place, axis=-1) for place in places])
        assert (far.min(0) < 13).all()
        assert ((far < 13).sum(1) > 50).all()
        x, y = 320 * 0.309 / 2 * np.array([np.cos(target[0]), np.sin(target[0])])
        assert np.abs(frame[248 - round(y), 240 + round(x)].astype(int) - LIGHT).sum() < 40
    env.close()


@pytest.mark.slow
def test_nothing_is_printed_and_no_log_is_written(tmp_path):
    code = (
        "import sys, gymnasium, paper.arm.system, numpy as np\n"
        "assert 'opensim' not in sys.modules\n"
        "env = gymnasium.make('MuscleArm-v0')\n"
        "env.reset(seed=0)\n"
        "env.step(np.full(4, 0.5, dtype=np.float32))\n"
        "import warnings; warnings.simplefilter('ignore')\n"
        "env.unwrapped.state[2] = 1e4\n"
        "assert env.step(np.zeros(4, dtype=np.float32))[3]\n"
    )
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}"}
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


def test_a_broken_opensim_says_so_itself(tmp_path, monkeypatch):
    (tmp_path / "opensim").mkdir()
    (tmp_path / "opensim" / "__init__.py").write_text("import opensim.missing_part")
    for name in [name for name in sys.modules if name.partition(".")[0] == "opensim"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"No module named 'opensim.missing_part'") as error:
        load_opensim.__wrapped__()
    assert "pip install" not in str(error.value)


def test_the_system_with_memory():
    reaching = system.arm(memory=True, strength=0.3)
    assert reaching.spec is ARM_MEMORY_SPEC
    env = reaching.make()
    observation, _ = env.reset(seed=0)
    assert observation.shape == (10,)
    assert reaching.start(3).shape == (3, 10)
    assert (reaching.start(3)[:, 6:] == 0).all()
    reaching.task().draw_initial_states(2)
    excite = np.array([0.0, 0.0, 0.5, 0.0], dtype=np.float32)
    assert env.step(excite)[0][6:].tolist() == [0.0, 0.0, 0.5, 0.0]
