"""Hidden states: the filter by a dense Gaussian, the smoother by what was simulated, agents."""

from dataclasses import replace
from functools import reduce

import gymnasium as gym
import numpy as np
import pytest
import torch

from gpadjust.control import (
    MPC,
    EpisodeCheckpoint,
    Estimate,
    MPCAgent,
    StateFilter,
    resume,
)
from gpadjust.control.state_filter import smooth_episodes
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, Trajectories
from gpadjust.states import Sensors, StateSpec
from gpadjust.systems import System, cart_pole
from tests.control.conftest import EVEN, KINDS, PLAN, point_of
from tests.systems import normal

SPEC = StateSpec(["x", "v"], ["force"])
TURNS = StateSpec(["x", "v"], ["force"], angles=["x"])
STEP, LENGTH, NOISE = 0.2, 8, 0.02


def doubles(*values):
    return torch.tensor(values, dtype=torch.float64)


def first_at(x, variances, *sd):
    """A filter of a mass that rests at x, by variances and by noises of outputs and states."""
    start = Estimate(doubles(x, 0.0), doubles(*variances).diag())
    return StateFilter(start, doubles(*sd[:-2]), doubles(*sd[-2:]))


def episodes_of(*episodes):
    """Episodes of ``T + 1`` observations and ``T`` actions."""
    steps = (
        Trajectories(seen[:-1], actions, seen[1:], torch.zeros(len(actions)))
        for seen, actions in episodes
    )
    return reduce(Trajectories.append, steps)


def glide(X, drag=0.0):
    x, v, force = X.unbind(-1)
    new = v + STEP * (force - drag * v)
    return torch.stack([x + STEP * (v + new) / 2, new], dim=-1)


def start(n):
    return doubles(1.0, 0.0) + 0.1 * torch.randn(n, 2, dtype=torch.float64)


def near_zero(states, actions, next_states):
    return -next_states[:, 0].square()


class Glider(gym.Env):
    """A mass with a drag of which the physics knows nothing."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.history = [np.array([1.0, 0.0]) + 0.1 * self.np_random.normal(size=2)]
        return self.history[-1].copy(), {}

    def step(self, action):
        state = glide(doubles([*self.history[-1], action[0]]), drag=0.5)[0].numpy()
        self.history.append(state)
        return state.copy(), -(state[0] ** 2), False, False, {}


def glider():
    dynamics = LearnedDynamics(SPEC, glide, fit_options={"method": "map"})
    parts = {
        "sensors": Sensors(["x"], noise={"x": NOISE}),
        "noise": {"x": NOISE},
        "episode_length": LENGTH,
        "start": start,
        "state_bounds": torch.tensor([[-50.0, -50.0], [50.0, 50.0]]),
    }
    system = System(Glider, SPEC, glide, near_zero, **parts)
    return system.make(), system.task(dynamics)


def task_of(sensors, physics=glide, spec=SPEC, **parts):
    parts = {"initial_states": start, "episode_length": 5, **parts}
    return point_of(physics, near_zero, spec, sensors=sensors, **parts)


# The filter and the smoother


@pytest.mark.parametrize(
    ("sensors", "row"),
    [(Sensors(["x"]), [1.0, 0.0]), (Sensors(["sum"], lambda s: s.sum(-1, keepdim=True)), [1, 1])],
)
def test_the_filter_is_the_conditional_distribution_of_a_linear_system(sensors, row):
    task, noise, added = task_of(sensors), 0.3, (0.1, 0.2)
    known = first_at(1.0, (0.5, 2.0), noise, *added)
    forces, seen = [0.5, -1.0], doubles([1.2], [0.9], [1.5])
    # Dense: states of all times by independent normal numbers.
    A, B = doubles([1.0, STEP], [0.0, 1.0]), doubles(STEP**2 / 2, STEP)
    mean, root = [known.start.mean], [torch.zeros(2, 6).double()]
    root[0][:, :2] = known.start.covariance.sqrt()
    for t, force in enumerate(forces):
        mean.append(A @ mean[-1] + B * force)
        new = A @ root[-1]
        new[:, 2 + 2 * t : 4 + 2 * t] += torch.diag(doubles(*added))
        root.append(new)
    H = doubles(*row)
    outputs = torch.stack([H @ each for each in root])
    gain = root[-1] @ outputs.T @ torch.linalg.inv(outputs @ outputs.T + noise**2 * torch.eye(3))
    off = seen[:, 0] - torch.stack([H @ each for each in mean])
    estimate = None
    for value, force in zip(seen, [*forces, 0.0], strict=True):
        (estimate,) = known.follow(task, value[None], [estimate])
        estimate = estimate._replace(action=doubles(force))
    torch.testing.assert_close(estimate.mean, mean[-1] + gain @ off)
    torch.testing.assert_close(estimate.covariance, (root[-1] - gain @ outputs) @ root[-1].T)


def test_angles_go_the_shortest_way():
    known = first_at(3.1, (1.0, 1.0), 1.0, 0.0, 0.0)
    seen = TURNS.observe(doubles([-3.1, 0.0]))[:, :2]
    (found,) = known.follow(task_of(Sensors(["x"]), spec=TURNS), seen, [None])
    assert abs(abs(found.mean[0]) - torch.pi) < 1e-9


def test_an_episode_may_begin_beyond_half_a_turn():
    """All is as it is where angles begin at zero, as nothing depends on where that is."""
    found = []
    for zero in (0.0, 3.1):
        known = first_at(zero, (0.1, 0.1), 0.03, 0.0, 0.01)
        rest = doubles([zero + 0.1, 0.0]).expand(6, 2)
        one = (TURNS.observe(rest)[:, :2], torch.zeros(5, 1).double())
        task = task_of(Sensors(["x"]), spec=TURNS)
        learnt, paths = smooth_episodes(task, known, episodes_of(one, one, one), seed=0)
        off = TURNS.change(rest[1:].repeat(3, 1), paths.next_states)
        found.append((learnt.noise, learnt.process_noise, off))
    torch.testing.assert_close(*found, rtol=1e-6, atol=1e-8)


def test_noises_and_hidden_states_are_found():
    task, rng = task_of(Sensors(["x"])), np.random.default_rng(0)
    episodes, truth = [], []
    for _ in range(6):
        states, forces = [start(1)[0]], torch.from_numpy(rng.choice([-1.0, 1.0], size=(40, 1)))
        for force in forces:
            state = glide(torch.cat([states[-1], force])[None])[0]
            states.append(state + torch.tensor([0.0, 0.1]) * torch.from_numpy(rng.normal(size=2)))
        truth.append(torch.stack(states))
        seen = truth[-1][:, :1] + 0.05 * torch.from_numpy(rng.normal(size=(41, 1)))
        episodes.append((seen, forces))
    known = StateFilter.guessed(task, EVEN)
    learnt, paths = smooth_episodes(task, known, episodes_of(*episodes), seed=0)
    assert abs(learnt.noise.item() / 0.05 - 1) < 0.15
    assert abs(learnt.process_noise[1].item() / 0.1 - 1) < 0.4
    error = paths.states - torch.cat([path[:-1] for path in truth])
    assert error[:, 1].square().mean().sqrt() < 0.2
    rough = (paths.next_states - paths.states)[:, 1].abs() - STEP
    assert rough.square().mean().sqrt() > 0.05  # as the machine's; the most likely path is smooth


def test_what_nothing_disturbs_stays_as_it_is_and_starts_vary_together():
    """A constant that is hidden is found from where starts vary with what is seen."""

    def stays(X):
        return torch.stack([X[:, 0] + X[:, 2], X[:, 1]], dim=-1)

    spec, sensors = StateSpec(["x", "bias"], ["force"]), Sensors(["x"], noise={"x": 0.01})
    task = task_of(sensors, stays, spec, initial_states=lambda n: normal(n, 1).expand(n, 2))
    known = StateFilter.guessed(task, EVEN)
    one = (torch.full((5, 1), 2.0).double(), torch.zeros(4, 1).double())
    learnt, paths = smooth_episodes(task, known, episodes_of(one, one, one), 0)
    assert known.process_noise[1] == learnt.process_noise[1] == 0
    assert (paths.states[:, 1] - 2).abs().max() < 0.2


def test_guesses_of_a_system_that_runs_away_are_those_of_its_first_steps():
    """Each step multiplies the state by 20."""
    short, long = (
        StateFilter.guessed(
            task_of(Sensors(["x"]), lambda X: 20 * X[:, :2] + X[:, 2:], episode_length=n), EVEN
        ).noise
        for n in (5, 200)
    )
    assert torch.equal(short, long)
    assert long.isfinite().all()


def test_intervals_hold_the_hidden_states_of_a_pendulum():
    def swing(X):
        x, v, force = X.unbind(-1)
        new = v + STEP * (force - 3 * x.sin())
        return torch.stack([x + STEP * (v + new) / 2, new], dim=-1)

    sensors = Sensors(["side", "height"], lambda s: torch.stack([s[:, 0].sin(), s[:, 0].cos()], -1))
    task, (added, noise) = task_of(sensors, swing, TURNS), (0.1, 0.05)
    known = first_at(1.0, (0.01, 0.09), noise, noise, 0.0, added)
    state = known.start.mean + known.start.covariance.diagonal().sqrt() * normal(40, 2)
    found, held = [None] * 40, []
    for t in range(30):
        values = sensors.measure(TURNS, state) + noise * normal(40, 2, seed=3 * t)
        found = known.follow(task, values, found)
        off = torch.stack([each.mean[1] for each in found]) - state[:, 1]
        sd = torch.stack([each.covariance[1, 1] for each in found]).sqrt()
        held.append((off.abs() < 1.96 * sd).double())
        forces = normal(40, 1, seed=3 * t + 1).tanh()
        found = [each._replace(action=force) for each, force in zip(found, forces, strict=True)]
        state = swing(torch.cat([state, forces], -1))
        state[:, 1] += added * normal(40, seed=3 * t + 2)
    assert 0.93 < torch.cat(held).mean() < 0.97
    assert sd.mean() < 0.25  # of rates of about 2


# Loops and agents


def test_a_loop_of_the_users_learns_from_positions_alone():
    env, task = glider()
    controller = MPC(task, [[-1.0], [1.0]], PLAN, first=PLAN)
    for episode in range(2):
        controller.reset()
        seen, _ = env.reset(seed=episode)
        for _ in range(LENGTH):
            seen, *_ = env.step(controller.step(seen))
        controller.observe(seen)
        before = controller.filter
        controller.learn()
        assert task.dynamics.num_transitions == LENGTH * (episode + 1)
    assert controller.filter is not before
    assert 0.3 < controller.filter.noise.item() / NOISE < 4
    states = torch.zeros(2, 2).double()
    with pytest.raises(ValueError, match=r"call learn\(\) without data"):
        controller.learn(Trajectories(states, states[:, :1], states))


@pytest.mark.slow
def test_agents_learn_from_positions_alone(kind, tmp_path):
    agent = kind(*glider(), **KINDS[kind].options, score_horizons=(), seed=0)
    recorded = agent.learn(2 * LENGTH, EpisodeCheckpoint(tmp_path / "run")).recorded_episodes()
    assert agent.task.dynamics.num_transitions == len(recorded) == 2 * LENGTH
    true = torch.from_numpy(np.stack(agent.env.unwrapped.history))
    off = (recorded.states[-LENGTH:] - true[:-1]).abs().amax(0)
    assert (off < torch.tensor([0.1, 0.3])).all()
    assert 0.4 < agent.filter.noise.item() / NOISE < 3
    whole = agent.learn(LENGTH).recorded_episodes()
    resumed = resume(tmp_path / "run", *glider()).learn(LENGTH).recorded_episodes()
    assert resumed.states.equal(whole.states)


def test_a_policy_keeps_its_estimates_and_forgets_them_where_an_episode_begins():
    _, task = glider()
    mpc = MPC(replace(task, dynamics=PhysicsDynamics(SPEC, glide)), EVEN, PLAN, first=PLAN)
    seen = np.array([[1.0], [0.5]])
    _, state = mpc.predict(seen)
    before = [each.estimate.covariance for each in state]
    assert before[0][0, 0] < before[0][1, 1]
    _, state = mpc.predict(seen, state, np.array([False, True]))
    assert not torch.equal(state[0].estimate.covariance, before[0])
    torch.testing.assert_close(state[1].estimate.covariance, before[1])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:A step of the last real episode")
def test_a_cart_pole_is_swung_up_by_position_and_angle_alone():
    noise = {"x": 0.01, "theta": 0.01}
    system = replace(cart_pole(100), sensors=Sensors(["x", "theta"]), noise=noise)
    agent = MPCAgent(system.make(), system.task(), score_horizons=(), seed=100).learn(2 * 25)
    assert -agent.recorded_episodes(newest=25).rewards.mean() < 0.36  # 0.29 with all states
    assert all(0.3 < found / 0.01 < 3 for found in agent.filter.noise.tolist())
