"""Dynamics that are a physics with unknown parameters, fitted by least squares of one step."""

import math

import pytest
import torch

from gpadjust.dynamics import PhysicsDynamics, StateSpec
from gpadjust.physics import FunctionPhysics, ODEPhysics, PhysicsError, PhysicsWarning, Unknown
from tests.point import assert_equal
from tests.systems import line, normal, refused

LINE = StateSpec(["x"], ["a"])
TRUTH = {"gravity": 9.0, "drag": 0.3}


def pendulum(state, action, p):
    theta, rate = state.unbind(-1)
    return torch.stack([rate, -p.gravity * theta.sin() - p.drag * rate + action[:, 0]], -1)


def swing(**guesses):
    unknowns = {
        "gravity": Unknown(guesses.get("gravity", 6.0), factor=2.0),
        "drag": Unknown(guesses.get("drag", 0.1), bounds=(0.0, 1.0)),
    }
    return ODEPhysics(pendulum, 0.1, 2, substeps=4, unknowns=unknowns)


PENDULUM = StateSpec(["theta", "rate"], ["torque"], angles=["theta"])


def swings(n=60, noise=0.0, seed=0):
    z = normal(n, 5, seed=seed)
    states, actions = 3 * z[:, :2], z[:, 2:3]
    values = torch.tensor([*TRUTH.values()], dtype=torch.float64)
    following = swing()(torch.cat([states, actions], -1), values)
    return states, actions, following + noise * torch.tensor([0.1, 1.0]) * z[:, 3:]


def fitted(*data):
    dynamics = PhysicsDynamics(PENDULUM, swing())
    dynamics.update(*data)
    return dynamics


def found(dynamics):
    parameters = dynamics.physics_parameters
    return {name: parameters[name].median().item() for name in parameters}


def test_without_noise_the_parameters_are_exact():
    dynamics = PhysicsDynamics(PENDULUM, swing())
    assert dynamics.physics_parameters.mean.tolist() == [6.0, 0.1]
    assert not PhysicsDynamics(LINE, lambda X: X[:, :1]).physics_parameters
    states, actions, following = swings()
    wrapped = torch.cat([following[:, :1].sin().atan2(following[:, :1].cos()), following[:, 1:]], 1)
    assert (wrapped - following).abs().max() > 6
    dynamics.update(states, actions, wrapped)
    assert found(dynamics) == pytest.approx(TRUTH, rel=1e-6)
    mean, variance = dynamics.predict(states, actions)
    torch.testing.assert_close(mean, following, rtol=0, atol=1e-6)
    assert (variance < 1e-10).all()


@pytest.mark.slow
def test_standard_errors_are_those_of_repeated_data():
    all_fitted = [fitted(*swings(40, noise=0.1, seed=seed)) for seed in range(40)]
    estimates = torch.stack([dynamics.physics_parameters.mean for dynamics in all_fitted])
    errors = torch.stack([dynamics.physics_parameters.sd for dynamics in all_fitted])
    spread = estimates.std(0)
    ratio = errors.mean(0) / spread
    assert ((ratio > 0.75) & (ratio < 1.33)).all()
    truth = torch.tensor([*TRUTH.values()], dtype=torch.float64)
    assert ((estimates.mean(0) - truth).abs() < 4 * spread / 40**0.5).all()


def test_linear_parameters_of_one_output_are_those_of_lstsq():
    X = normal(30, 2, seed=1)
    y = X @ torch.tensor([[0.4], [-1.3]]).double() + 0.2 * normal(30, 1, seed=2)
    unknowns = {"a": Unknown(0.0, sd=1e3), "b": Unknown(0.0, sd=1e3)}
    line = FunctionPhysics(lambda X, p: p.a * X[:, 0] + p.b * X[:, 1], unknowns=unknowns)
    dynamics = PhysicsDynamics(LINE, line)
    dynamics.update(X[:, :1], X[:, 1:], y)
    expected = torch.linalg.lstsq(X, y).solution.flatten()
    torch.testing.assert_close(dynamics._values, expected, rtol=1e-4, atol=1e-5)
    rest = y - X @ expected.unsqueeze(-1)
    variance = rest.square().sum() / 28  # two degrees of freedom less
    torch.testing.assert_close(dynamics.noise_variance(y[:1], y[:1]), variance.view(1, 1))
    errors = (variance * torch.linalg.inv(X.mT @ X).diagonal()).sqrt()
    # The density takes the mean square without these degrees.
    errors = errors * (28 / 30) ** 0.5
    torch.testing.assert_close(dynamics.physics_parameters.sd, errors, rtol=0.02, atol=0)


def test_each_state_counts_in_units_of_its_own_error_where_it_was_measured():
    states, actions, following = swings(80, noise=0.1)
    following[:, 0] += 0.8 * normal(80, seed=3)
    dynamics = fitted(states, actions, following)
    assert found(dynamics)["gravity"] == pytest.approx(9.0, rel=0.03)
    noise = dynamics.noise_variance(states[:1], actions[:1]).sqrt()[0]
    assert noise.tolist() == pytest.approx([0.8, 0.1], rel=0.2)
    states, actions, gaps = swings(80, noise=0.05)
    gaps[40:, 0] = gaps[:40, 1] = torch.nan
    dynamics = fitted(states, actions, gaps)
    assert found(dynamics)["gravity"] == pytest.approx(9.0, rel=0.03)
    assert dynamics.noise_variance(states, actions).isfinite().all()


def test_a_parameter_of_which_nothing_is_known_stays_where_it_was():
    states, actions, following = swings(noise=0.01)
    states[:, 1] = 0  # no drag
    unknowns = {**swing().unknowns, "buoyancy": Unknown(2.0, sd=0.5)}
    physics = ODEPhysics(pendulum, 0.1, 2, substeps=4, unknowns=unknowns)
    dynamics = PhysicsDynamics(PENDULUM, physics)
    with pytest.warns(PhysicsWarning, match="barely constrain .*buoyancy"):
        dynamics.update(states, actions, following)
    assert found(dynamics)["buoyancy"] == pytest.approx(2.0, abs=0.01)
    assert dynamics.physics_parameters.sd[2] == pytest.approx(0.5, rel=0.02)


def test_an_update_goes_by_all_transitions_so_far():
    states, actions, following = swings(60, noise=0.1)
    at_once = fitted(states, actions, following)
    later = fitted(states[:20], actions[:20], following[:20])
    before = later.mean_function()
    first = before(states, actions)
    later.update(states[20:], actions[20:], following[20:])
    assert torch.equal(later._values, at_once._values)
    assert torch.equal(before(states, actions), first)  # a function stays as it was
    assert not torch.equal(later.mean_function()(states, actions), first)


def test_a_dynamics_that_was_saved_goes_on_bit_for_bit():
    data = swings(60, noise=0.1)
    one, other = fitted(*(part[:30] for part in data)), PhysicsDynamics(PENDULUM, swing())
    other.load_state_dict(one.state_dict())
    for dynamics in (one, other):
        dynamics.update(*(part[30:] for part in data))
    assert_equal(one.state_dict(), other.state_dict())
    assert torch.equal(one.physics_parameters.draws, other.physics_parameters.draws)
    state = one.state_dict()
    other.load_state_dict(PhysicsDynamics(PENDULUM, swing()).state_dict())
    assert found(other) == {"gravity": 6.0, "drag": 0.1}
    guessed = PhysicsDynamics(PENDULUM, swing(gravity=7.0))
    refused(RuntimeError, r"unknowns is .* in the state", guessed.load_state_dict, state)
    for damage in ({"point": torch.zeros(3).double()}, {"noise": None}, {"transitions": {}}):
        damaged = {**state, "fitted": {**state["fitted"], **damage}}
        refused(RuntimeError, "damaged", other.load_state_dict, damaged)


def test_values_at_which_the_physics_fails_are_not_tried_further():
    def root(X, p):
        if (p.a < 0.5).any():
            raise ValueError("no such thing")
        return (p.a - 0.5).sqrt().unsqueeze(-1) * X[:, :1]

    x = line(9, 1.0, 2.0)
    physics = FunctionPhysics(root, unknowns={"a": Unknown(1.0, bounds=(0.0, 3.0))})
    dynamics = PhysicsDynamics(LINE, physics)
    dynamics.update(x, x, 0.5 * x)
    assert dynamics._values.item() == pytest.approx(0.75, rel=1e-6)
    always = FunctionPhysics(lambda X, p: X[:, :1] / 0, unknowns={"a": Unknown(1.0, sd=1.0)})
    refused(PhysicsError, "NaN or inf", PhysicsDynamics(LINE, always).update, x, x, x)


def test_several_optima_are_told_apart():
    """A sine of unknown frequency: from the guess alone, descent ends elsewhere."""
    x, unknowns = line(25, 0.0, 3.0), {"omega": Unknown(2.0, bounds=(0.0, 20.0))}
    physics = FunctionPhysics(lambda X, p: (p.omega * X[:, 0]).sin(), unknowns=unknowns)
    dynamics = PhysicsDynamics(LINE, physics)
    dynamics.update(x, x, (13.0 * x).sin())
    assert dynamics._values.item() == pytest.approx(13.0, rel=1e-6)


def test_samples_have_the_noise_and_functions_have_none():
    states, actions, following = swings(60, noise=0.3)
    dynamics = fitted(states, actions, following)
    state, action = states[:1].expand(4000, -1), actions[:1].expand(4000, -1)
    drawn = dynamics.sample(state, action)
    mean, variance = dynamics.predict(states[:1], actions[:1])
    torch.testing.assert_close(drawn.mean(0), mean[0], rtol=0, atol=0.02)
    torch.testing.assert_close(drawn.var(0), variance[0], rtol=0.1, atol=0)
    functions = dynamics.sample_functions(2)(states.expand(2, -1, -1), actions.expand(2, -1, -1))
    assert torch.equal(functions[0], functions[1])
    assert math.isclose(variance[0, 1] ** 0.5, 0.3, rel_tol=0.2)


def test_more_transitions_than_are_searched_by():
    assert found(fitted(*swings(2000, noise=0.1))) == pytest.approx(TRUTH, rel=0.05)
