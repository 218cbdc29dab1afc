"""The experiment on planning in the first trials."""

import numpy as np
import pytest
import torch
from paper.planning import LEARNERS, SMALL_NOISE, SYSTEMS, Planning, Settings
from paper.planning.figure import COLORS
from paper.planning.run import dynamics
from paper.planning.systems import (
    FittedPhysics,
    FrictionEquation,
    environment,
    equation,
    mc_pilco_reward,
)

from gpadjust.envs import REAL_CART_POLE, random_cart_pole_physics
from gpadjust.envs.cart_pole.system import START_MEAN, equation_physics
from paper.common.runner import rounded

TINY = Settings(
    trials=2,
    episode_length=5,
    horizon=2,
    sequences=12,
    rounds=0,
    elites=3,
    first_sequences=12,
    first_rounds=0,
    restarts=1,
    updates=2,
    starts=4,
    guides=1,
)


def test_a_run_and_its_tables(tmp_path):
    experiment = Planning(out=tmp_path, runs=1, jobs=1, settings=TINY, learners=("phy", "gp"))
    assert len(experiment.tasks()) == 2 * len(SYSTEMS)
    records = []
    for learner in experiment.learners:
        found = rounded(experiment.run("sensors", learner, 0, unfinished=tmp_path / "x"))
        assert all(0 <= cost <= 1 for cost in found["trials"]["cost"])
        assert len(found["trials"]["cost"]) == 2
        records.append({"system": "sensors", "learner": learner, "seed": 0, **found})
    tables = experiment.tables(records)
    assert {*tables} == {"sensors", "short", "targets", "seconds"}
    assert "not run" in tables["targets"].text
    assert [path.name for path in experiment.draw(records)] == ["planning.png"]


def test_all_models_have_a_colour():
    assert COLORS.keys() == LEARNERS.keys()


@pytest.mark.parametrize("learner", LEARNERS)
def test_all_models_are_known(learner):
    assert dynamics(TINY, "friction", learner, 0).spec.states[0] == "x"


def test_unknown_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match="--systems: there is no 'moon', but there are plain"):
        Planning(out=tmp_path, systems=("moon",)).check()


def test_friction_takes_energy_and_is_none_at_rest():
    torch.manual_seed(0)
    states = torch.randn(20, 4, dtype=torch.float64)
    nothing = torch.zeros(20, 1, dtype=torch.float64)
    rough = equation("friction")
    assert isinstance(rough, FrictionEquation)

    def power(equation):
        state = states.clone().requires_grad_(True)
        (slope,) = torch.autograd.grad(REAL_CART_POLE.energy(state).sum(), state)
        return (slope * equation(states, nothing)).sum(-1)

    speed, spin = states[:, 2], states[:, 3]
    lost = rough.dry * speed * (speed / 0.05).tanh() + rough.drag * spin.abs() ** 3
    torch.testing.assert_close(power(rough), power(REAL_CART_POLE) - lost)
    states[:, 2:] = 0
    torch.testing.assert_close(rough(states, nothing), REAL_CART_POLE(states, nothing))


def test_mc_pilcos_protocol_has_small_steps_still_starts_and_noise():
    """Half a step twice, from the true state that is watched, is what noisy sensors see."""
    settings = Planning().settings_of("mc-pilco")
    assert settings.trials - settings.random_trials == 5
    assert settings.episode_length * settings.time_step == 3
    env = environment("mc-pilco", settings)
    starts, seen = [], []
    for seed in range(30):
        observation, _ = env.reset(seed=seed)
        starts.append(env.unwrapped.state)
        seen.append(np.array([observation[0], *observation[3:]]) - starts[-1][[0, 2, 3]])
    for found in (starts - np.array(START_MEAN), seen):
        assert np.std(found) == pytest.approx(SMALL_NOISE, rel=0.25)
    env.step(np.array([3.0], dtype=np.float32))
    row = torch.tensor([[*starts[-1], 3.0]])
    torch.testing.assert_close(
        torch.from_numpy(np.stack(env.episodes[-1])),
        equation_physics(REAL_CART_POLE, 0.05)(row.double()),
        rtol=0,
        atol=1e-9,
    )


def test_mc_pilcos_cost_is_that_of_angle_and_place():
    states = torch.tensor([[0.0, 2 * np.pi, 9.0, 9.0], [1.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 0.0]])
    found = mc_pilco_reward(states, states, states.double())
    expected = torch.tensor([0.0, np.exp(-1) - 1, np.exp(-1) - 1], dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)


def test_a_policy_is_searched_for_and_the_last_second_is_watched(tmp_path):
    experiment = Planning(out=tmp_path, runs=1, jobs=1, settings=TINY)
    trials = experiment.run("plain", "search", 0, unfinished=tmp_path / "x")["trials"]
    assert len(trials["cost"]) == 2
    assert all(0 <= lean <= 180 for lean in trials["last_lean"])


def test_fitted_physics_finds_the_parameters():
    env = environment("plain", Settings())
    env.action_space.seed(0)
    env.reset(seed=0)
    rows, actions = [env.unwrapped.state], []
    for _ in range(25):
        action = env.action_space.sample()
        env.step(action)
        actions.append(torch.from_numpy(action).double())
        rows.append(env.unwrapped.state)
    states = torch.stack([torch.from_numpy(row) for row in rows])
    fitted = FittedPhysics(random_cart_pole_physics(3).rhs, 0.1)
    fitted.update(states[:-1], torch.stack(actions), states[1:])
    real = (REAL_CART_POLE.cart_mass, REAL_CART_POLE.pole_mass)
    real = torch.tensor([*real, REAL_CART_POLE.pole_length, REAL_CART_POLE.damping])
    torch.testing.assert_close(fitted.equation.logs.exp(), real.double(), rtol=0.02, atol=0)
