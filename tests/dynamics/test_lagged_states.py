"""Earlier outputs and actions among the states (NARX), and a physics of columns that are named."""

import math

import pytest
import torch

from gpadjust import Unknown, ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import FunctionPhysics
from gpadjust.records import Record, Records, smooth
from tests.point import assert_equal
from tests.systems import normal, refused, uniform

QUICK = {"method": "map"}
LAGS = {"y_1": "y", "u_1": "u"}
FIRST_ORDER = StateSpec(["y"], ["u"])
NARX = StateSpec(["y", *LAGS], ["u"], previous=LAGS)


def oscillation(num_rows, seed):
    """Outputs and inputs of an oscillator, of which the output alone is measured."""
    u = normal(num_rows, seed=seed)
    y = [torch.zeros((), dtype=torch.float64)] * 2
    for k in range(1, num_rows - 1):
        y.append(1.6 * y[k] - 0.8 * y[k - 1] + 0.2 * (u[k] + u[k - 1]))
    return torch.stack(y), u


def windows_of(spec, length, seed=1):
    """Windows of 45 rows."""
    y, u = oscillation(45, seed)
    states = torch.full((45, spec.state_dim), math.nan, dtype=torch.float64)
    states[:, spec.states.index("y")] = y
    record = Record(torch.arange(45).double(), states, u.unsqueeze(-1))
    return Records(record, spec).windows(length)


def steps_of(spec, seed=1):
    """Transitions of these rows: states, actions, next states."""
    states, actions, following = windows_of(spec, 1, seed)
    return states, actions[:, 0], following[:, 0]


def learnt(spec, physics=None, **options):
    dynamics = LearnedDynamics(spec, physics, fit_options=QUICK, **options)
    states, actions, following = steps_of(NARX, 0)
    columns = [NARX.states.index(name) for name in spec.states]
    dynamics.update(states[:, columns], actions, following[:, columns])
    return dynamics


def test_a_free_run_follows_a_second_order_system_of_one_measured_output():
    errors = []
    for spec in (FIRST_ORDER, NARX):
        windows = windows_of(spec, 20)
        dynamics = learnt(spec, model=ZeroMeanGP)
        run = dynamics.free_run(windows.initial_states, windows.actions, noise=False)
        errors.append((run.mean - windows.measured)[..., 0].square().mean().sqrt())
    size = oscillation(45, 1)[0].square().mean().sqrt()
    assert errors[0] > 0.5 * size, "the state of a first-order model is not the system's"
    assert errors[1] < 0.02 * size
    y, y_1, u_1 = run.particles.unbind(-1)
    torch.testing.assert_close(y_1[:, :, 1:], y[:, :, :-1])
    torch.testing.assert_close(u_1, windows.actions[..., 0].expand(39, -1, -1))


def test_physics_knows_the_present_only_and_a_model_both():
    def physics(X):
        assert X.shape[-1] == 2
        return 1.6 * X[:, :1] + 0.2 * X[:, 1:]

    dynamics, alone = learnt(NARX, physics), PhysicsDynamics(NARX, physics)
    states, actions, following = steps_of(NARX)
    assert dynamics.score(states, actions, following).rmse.item() < 0.02
    alone.update(states, actions, following)
    assert dynamics.model.data.input_names == ("y", "u", "y_1", "u_1")
    for each in (alone, dynamics):
        moved = each.sample(states, actions)
        assert torch.equal(moved[:, 1:], torch.cat([states[:, :1], actions], -1))
    assert not dynamics.predict(states, actions).variance[:, 1:].any()
    assert not dynamics.noise_variance(states, actions)[:, 1:].any()
    words = "'y_1' is declared as the previous state 'y'"
    refused(ValueError, words, dynamics.update, states, actions, following.flip(0))


def test_a_state_is_loaded_with_the_same_previous_values_in_any_order():
    dynamics = learnt(NARX, model=ZeroMeanGP)
    again, other = (
        LearnedDynamics(
            StateSpec(NARX.states, ["u"], previous=previous), model=ZeroMeanGP, fit_options=QUICK
        )
        for previous in (dict([*LAGS.items()][::-1]), {"y_1": "y", "u_1": "y_1"})
    )
    again.load_state_dict(dynamics.state_dict())
    states, actions, _ = steps_of(NARX)
    assert_equal(*([*each.predict(states, actions)] for each in (again, dynamics)))
    words = r"previous is {'u_1': 'u', .* in the state"
    refused(RuntimeError, words, other.load_state_dict, dynamics.state_dict())


def test_a_model_reads_the_point_of_the_circle_of_an_earlier_angle(uniform):
    """A rotor turns on as in the step before, and by the action; its rate is not measured."""
    spec = StateSpec(["q_1", "q"], ["u"], angles=["q", "q_1"], previous={"q_1": "q"})
    q_1, rate, u = uniform(60, 3, low=-1).split(1, -1)
    q_1, q = 9 * q_1, 9 * q_1 + rate
    following = torch.cat([q, q + rate + 0.1 * u], -1)
    states = torch.cat([q_1, q], -1)
    dynamics = LearnedDynamics(spec, model=ZeroMeanGP, fit_options=QUICK)
    dynamics.update(states, u, following)
    for name in ("sin(q_1)", "cos(q_1)", "sin(q)", "cos(q)"):
        assert f"lengthscale of {name}:" in dynamics.model.summary()
    turned = states + 2 * math.pi * torch.tensor([3, -2]).double()
    mean = dynamics.predict(turned, u).mean
    error = spec.change(mean, following)
    assert error[:, 0].abs().max() < 1e-12
    assert error[:, 1].abs().max() < 0.1


# A physics of columns that the spec names: earlier actions, loads


READS = StateSpec(
    ["u_1", "x", "load"],
    ["u"],
    exogenous=["load"],
    previous={"u_1": "u"},
    physics_reads=["load", "u_1", "x"],
)


def late(X):  # the force of one step before, less the load
    return (X[:, 2] + 0.5 * X[:, 1] - X[:, 0]).unsqueeze(-1)


@pytest.fixture
def rows():
    states, actions = uniform(12, 3), uniform(12, 1, seed=1)
    x = states[:, 1:2] + 0.5 * states[:, :1] - states[:, 2:]
    return states, actions, torch.cat([actions, x, states[:, 2:]], -1)


def test_the_physics_reads_what_the_spec_names(rows):
    states, actions, following = rows
    assert READS.physics_columns == [2, 0, 1]
    dynamics = PhysicsDynamics(READS, late)
    assert torch.allclose(dynamics.predict(states, actions).mean, following)
    along = dynamics.sample_functions(2)(states.expand(2, 12, 3), actions)
    assert torch.allclose(along, following.expand(2, 12, 3))
    unknowns = {"gain": Unknown(0.4, factor=2.0)}
    physics = FunctionPhysics(lambda X, p: X[:, 2] + p.gain * X[:, 1] - X[:, 0], unknowns=unknowns)
    dynamics = PhysicsDynamics(READS, physics)
    dynamics.update(*rows)
    assert float(dynamics.physics_parameters.mean) == pytest.approx(0.5, abs=1e-3)


def test_models_read_what_the_physics_reads(rows):
    dynamics = LearnedDynamics(READS, late, fit_options={"method": "map"})
    assert dynamics.targets.input_names == ("x", "u", "u_1", "load")
    dynamics.update(*rows)
    assert torch.allclose(dynamics.predict(*rows[:2]).mean, rows[2], atol=1e-4)
    assert torch.allclose(dynamics.mean_function()(rows[0][None], rows[1])[0], rows[2], atol=1e-4)


def test_by_default_it_reads_what_moves_and_the_actions():
    spec = StateSpec(["u_1", "x", "load"], ["u"], exogenous=["load"], previous={"u_1": "u"})
    assert spec.physics_columns == [1, 3]
    assert spec.model_columns == [1, 3, 0]
    for name in ("force", "x"):
        with pytest.raises(ValueError, match=f"physics_reads .*{name!r}.* (neither|both)"):
            StateSpec(["x"], ["u", "x"], physics_reads=["u", name])


def test_records_are_smoothed_by_the_force_of_one_step_before():
    spec = StateSpec(["x", "u_1"], ["u"], previous={"u_1": "u"}, physics_reads=["x", "u_1"])
    physics = FunctionPhysics(lambda X: 0.9 * X[:, :1] + X[:, 1:])
    u, x = normal(60, 1), torch.zeros(60, 1).double()
    for t in range(1, 59):
        x[t + 1] = 0.9 * x[t] + u[t - 1]
    # The force before is filled in from the actions, but for the first row.
    noisy = torch.cat([x + 0.1 * normal(60, 1, seed=1), torch.full_like(x, torch.nan)], -1)
    records = Records(Record(0.1 * torch.arange(60).double(), noisy, u), spec)
    found = smooth(records, physics).records.records[0].states
    assert len(found) == 59
    error, raw = ((each[:, 0] - x[1:, 0]).square().mean().sqrt() for each in (found, noisy[1:]))
    assert error < 0.7 * raw
