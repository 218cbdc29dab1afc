"""A physics of columns that the spec names: earlier actions, loads."""

import pytest
import torch

from gpadjust import Unknown
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import FunctionPhysics
from gpadjust.records import Record, Records, smooth

SPEC = StateSpec(
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
    assert SPEC.physics_columns == [2, 0, 1]
    dynamics = PhysicsDynamics(SPEC, late)
    assert torch.allclose(dynamics.predict(states, actions).mean, following)
    along = dynamics.sample_functions(2)(states.expand(2, 12, 3), actions)
    assert torch.allclose(along, following.expand(2, 12, 3))


def test_models_read_what_the_physics_reads(rows):
    dynamics = LearnedDynamics(SPEC, late, fit_options={"method": "map"})
    assert dynamics.targets.input_names == ("x", "u", "u_1", "load")
    dynamics.update(*rows)
    assert torch.allclose(dynamics.predict(*rows[:2]).mean, rows[2], atol=1e-4)
    assert torch.allclose(dynamics.mean_function()(rows[0][None], rows[1])[0], rows[2], atol=1e-4)


def test_unknown_parameters_are_fitted_by_those_columns(rows):
    def gain(X, p):
        return X[:, 2:] + p.gain.unsqueeze(-1) * X[:, 1:2] - X[:, :1]

    physics = FunctionPhysics(gain, unknowns={"gain": Unknown(0.4, factor=2.0)})
    dynamics = PhysicsDynamics(SPEC, physics)
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
