"""The chapter of control: systems that people know, and first trials."""

import pickle
import warnings

import pytest
import torch
from gymnasium.utils.env_checker import check_env

from paper.control import First, FirstSettings, Known, KnownSettings, first
from paper.control.known import run, tables
from paper.control.systems import SYSTEMS

LIGHT = KnownSettings(
    trials=2,
    sequences=8,
    rounds=0,
    first_sequences=8,
    first_rounds=0,
    elites=2,
    networks=3,
    training=20,
)


@pytest.fixture(params=SYSTEMS)
def name(request):
    if request.param == "reacher":
        pytest.importorskip("mujoco")
    return request.param


def steps_of(system, number):
    """States, actions, next states and rewards of random steps of the environment."""
    env, spec = system.make(), system.spec
    env.action_space.seed(0)
    observation, _ = env.reset(seed=1)
    rows = []
    for _ in range(number):
        action = env.action_space.sample()
        before = spec.decode(torch.as_tensor(observation).double())
        observation, reward, *_ = env.step(action)
        after = spec.decode(torch.as_tensor(observation).double())
        rows.append((before, torch.as_tensor(action).double(), after, torch.tensor(reward)))
    return [torch.stack(column) for column in zip(*rows, strict=True)]


def errors(system, states, actions, following):
    """How far the physics is off, for each state that moves."""
    moving = system.spec.moving
    predicted = following.clone()
    predicted[:, moving] = system.physics(torch.cat([states[:, moving], actions], -1))
    return system.spec.change(following, predicted).abs().amax(0)[moving]


@pytest.mark.filterwarnings("ignore:.*WARN.*")
def test_true_physics_is_the_environment_and_the_crude_one_is_not(name):
    true, crude, unknown = (SYSTEMS[name](kind) for kind in ("true", "crude", "unknown"))
    steps = steps_of(true, 12)
    states, actions, following, rewards = steps
    # Gymnasium's Euler steps err, and single precision rounds.
    tolerance = {"pendulum": 0.02, "reacher": 0.03}.get(name, 1e-9)
    assert errors(true, *steps[:3]).max() < tolerance
    assert errors(crude, *steps[:3]).max() > 5 * tolerance
    torch.testing.assert_close(errors(crude, *steps[:3]), errors(unknown, *steps[:3]))
    near = {"atol": 2e-3, "rtol": 0.0}  # Reacher-v5's target has a height
    torch.testing.assert_close(true.reward(states, actions, following), rewards.double(), **near)
    assert rewards.min() >= -1
    assert rewards.max() <= 0


@pytest.mark.filterwarnings("ignore:.*WARN.*")
def test_environments_are_gymnasiums(name):
    system = SYSTEMS[name]("crude")
    env = system.make()
    check_env(env, skip_render_check=True)
    assert system.spec.step > 0
    assert 25 <= system.episode_length <= 60
    observation, _ = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    assert (observation == again).all()
    system.spec.check_observations(torch.as_tensor(observation))
    assert pickle.loads(pickle.dumps(system)).spec == system.spec


@pytest.mark.slow
def test_rivals_of_a_system_make_a_table():
    known = Known(settings=LIGHT)
    runs = []
    for learner in ("fitted", "ensemble", "networks"):
        found = run(known, "tanks", learner, 0)
        assert {len(values) for values in found["trials"].values()} == {2}
        runs.append({"system": "tanks", "learner": learner, "seed": 0, **found})
    first = [found["trials"]["cost"][0] for found in runs]
    assert first[0] == first[1] != first[2]  # planned in f_p; random without
    text = tables(runs, known)["costs"].text
    assert "| f_p and an ensemble of networks | 0.0" in text


@pytest.mark.slow
def test_first_trials_make_a_table():
    experiment = First(settings=FirstSettings(trials=1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = first.run(experiment, "truth", 0)
    assert 0.1 < found["trials"]["cost"][0] < 0.42
    text = first.tables([{"model": "truth", "seed": 0, **found}], experiment)["trials"].text
    assert "the true system, trial 1" in text
