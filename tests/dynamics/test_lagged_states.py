"""Earlier outputs and actions among the states (NARX), and a physics of columns that are named."""

import math

import pytest
import torch

from gpadjust import Unknown, ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import FunctionPhysics
from gpadjust.records import Record, Records, smooth
from tests.systems import normal

QUICK = {"method": "map"}
LAGS = {"y_1": "y", "u_1": "u"}
FIRST_ORDER = StateSpec(["y"], ["u"])
NARX = StateSpec(["y", *LAGS], ["u"], previous=LAGS)


def oscillation(num_rows, seed):
    """Times, outputs and inputs of an oscillator, of which the output alone is measured."""
    u = normal(num_rows, seed=seed)
    y = [torch.zeros((), dtype=torch.float64)] * 2
    for k in range(1, num_rows - 1):
        y.append(1.6 * y[k] - 0.8 * y[k - 1] + 0.2 * (u[k] + u[k - 1]))
    return torch.arange(num_rows).double(), torch.stack(y), u


def records_of(spec, num_rows, seed):
    times, y, u = oscillation(num_rows, seed)
    states = torch.full((num_rows, spec.state_dim), math.nan, dtype=torch.float64)
    states[:, spec.states.index("y")] = y
    return Records(Record(times, states, u.unsqueeze(-1)), spec)


def learnt(spec, physics=None, **options):
    dynamics = LearnedDynamics(spec, physics, fit_options=QUICK, **options)
    states, actions, following = records_of(NARX, 45, 0).windows(1)
    columns = [NARX.states.index(name) for name in spec.states]
    dynamics.update(states[:, columns], actions[:, 0], following[:, 0, columns])
    return dynamics


def test_a_free_run_follows_a_second_order_system_of_one_measured_output():
    errors = []
    for spec in (FIRST_ORDER, NARX):
        windows = records_of(spec, 45, 1).windows(20)
        dynamics = learnt(spec, model=ZeroMeanGP)
        run = dynamics.free_run(windows.initial_states, windows.actions, noise=False)
        errors.append((run.mean - windows.measured)[..., 0].square().mean().sqrt())
    size = oscillation(45, 1)[1].square().mean().sqrt()
    assert errors[0] > 0.5 * size, "the state of a first-order model is not the system's"
    assert errors[1] < 0.02 * size
    y, y_1, u_1 = run.particles.unbind(-1)
    torch.testing.assert_close(y_1[:, :, 1:], y[:, :, :-1])
    torch.testing.assert_close(u_1, windows.actions[..., 0].expand(39, -1, -1))


def test_physics_knows_the_present_only_and_a_model_both():
    def physics(X):
        assert X.shape[-1] == 2
        return 1.6 * X[:, :1] + 0.2 * X[:, 1:]

    dynamics = learnt(NARX, physics)
    states, actions, following = records_of(NARX, 45, 1).windows(1)
    scores = dynamics.score(states, actions[:, 0], following[:, 0])
    assert scores.rmse.shape == (1,)
    assert scores.rmse < 0.02
    alone = PhysicsDynamics(NARX, physics)
    alone.update(states, actions[:, 0], following[:, 0])
    assert dynamics.model.data.input_names == ("y", "u", "y_1", "u_1")
    for each in (alone, dynamics):
        moved = each.sample(states, actions[:, 0])
        assert torch.equal(moved[:, 1:], torch.cat([states[:, :1], actions[:, 0]], -1))
    assert (dynamics.predict(states, actions[:, 0]).variance[:, 1:] == 0).all()
    assert (dynamics.noise_variance(states, actions[:, 0])[:, 1:] == 0).all()
    with pytest.raises(ValueError, match="'y_1' is declared as the previous state 'y'"):
        dynamics.update(states, actions[:, 0], following[:, 0].flip(0))


def test_a_state_is_loaded_with_the_same_previous_values_in_any_order():
    dynamics = learnt(NARX, model=ZeroMeanGP)
    turned = dict([*LAGS.items()][::-1])
    again, other = (
        LearnedDynamics(
            StateSpec(NARX.states, ["u"], previous=previous), model=ZeroMeanGP, fit_options=QUICK
        )
        for previous in (turned, {"y_1": "y", "u_1": "y_1"})
    )
    again.load_state_dict(dynamics.state_dict())
    states, actions, _ = records_of(NARX, 45, 1).windows(1)
    both = (each.predict(states, actions[:, 0]) for each in (again, dynamics))
    for loaded, expected in zip(*both, strict=True):
        assert torch.equal(loaded, expected)
    with pytest.raises(RuntimeError, match=r"previous is {'u_1': 'u', .* in the state"):
        other.load_state_dict(dynamics.state_dict())


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
    torch.manual_seed(0)
    states, actions = torch.rand(12, 3).double(), torch.rand(12, 1).double()
    following = states.clone()
    following[:, 1] += 0.5 * states[:, 0] - states[:, 2]
    following[:, 0] = actions[:, 0]
    return states, actions, following


def test_the_physics_reads_what_the_spec_names(rows):
    states, actions, following = rows
    assert READS.physics_columns == [2, 0, 1]
    dynamics = PhysicsDynamics(READS, late)
    assert torch.allclose(dynamics.predict(states, actions).mean, following)
    along = dynamics.sample_functions(2)(states.expand(2, 12, 3), actions)
    assert torch.allclose(along, following.expand(2, 12, 3))


def test_models_read_what_the_physics_reads(rows):
    dynamics = LearnedDynamics(READS, late, fit_options={"method": "map"})
    assert dynamics.targets.input_names == ("x", "u", "u_1", "load")
    dynamics.update(*rows)
    assert torch.allclose(dynamics.predict(*rows[:2]).mean, rows[2], atol=1e-4)
    assert torch.allclose(dynamics.mean_function()(rows[0][None], rows[1])[0], rows[2], atol=1e-4)


def test_unknown_parameters_are_fitted_by_those_columns(rows):
    def gain(X, p):
        return X[:, 2:] + p.gain.unsqueeze(-1) * X[:, 1:2] - X[:, :1]

    physics = FunctionPhysics(gain, unknowns={"gain": Unknown(0.4, factor=2.0)})
    dynamics = PhysicsDynamics(READS, physics)
    dynamics.update(*rows)
    assert float(dynamics.physics_parameters.mean) == pytest.approx(0.5, abs=1e-3)


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
    torch.manual_seed(0)
    u, x = torch.randn(60, 1).double(), torch.zeros(60, 2).double()
    for t in range(59):
        x[t + 1, 0] = 0.9 * x[t, 0] + (u[t - 1, 0] if t else 0.0)
    noisy = x + 0.1 * torch.randn(60, 2).double()
    noisy[:, 1] = torch.nan  # filled in from the actions, but for the first row
    records = Records(Record(0.1 * torch.arange(60).double(), noisy, u), spec)
    smoothed = smooth(records, physics)
    found = smoothed.records.records[0].states
    assert len(found) == 59
    error, raw = ((each - x[1:, 0]).square().mean().sqrt() for each in (found[:, 0], noisy[1:, 0]))
    assert error < 0.7 * raw
    lagged = StateSpec(["x", "x_1"], ["u"], previous={"x_1": "x"}, physics_reads=["x_1", "u"])
    records = Records(records.records, lagged)
    with pytest.raises(ValueError, match="'x_1', an earlier value of the state 'x'"):
        smooth(records, physics)
