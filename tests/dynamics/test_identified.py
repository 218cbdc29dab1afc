"""Dynamics of a physics with a posterior of its parameters."""

import pytest
import torch

from gpadjust.control import MPC, Planner, Task
from gpadjust.dynamics import IdentifiedDynamics
from gpadjust.physics import FormulaPhysics, FunctionPhysics, PhysicsParameters, Unknown
from gpadjust.states import StateSpec
from tests.systems import normal, refused, same, uniform

SPEC = StateSpec(["goal", "x"], ["u"], exogenous=["goal"])
PRIOR = Unknown(1.0, sd=0.5)
Q, R = 0.02, 0.1  # standard deviations of process and sensors


def made(draws, formula="x + a * u", unknowns=None):
    """x' = x + a u, with these draws of a, or another formula."""
    unknowns = {"a": PRIOR} if unknowns is None else unknowns
    parameters = PhysicsParameters(unknowns, draws)
    noises = (torch.tensor([0.0, sd]).double() for sd in (R, Q))
    physics = FormulaPhysics(formula, ["x", "u"], unknowns=unknowns)
    return IdentifiedDynamics(SPEC, physics, parameters, *noises)


def moves(number=30):
    """States, actions, and next states of a system whose a is 1.3."""
    states, actions = normal(number, 2), uniform(number, 1, low=-1.0, high=1.0)
    following = states.clone()
    following[:, 1:] += 1.3 * actions + 0.15 * normal(number, 1, seed=1)
    return states, actions, following


def test_its_variance_is_of_parameters_and_process_noise():
    draws = 1.0 + 0.2 * normal(32)
    states, actions, _ = moves()
    mean, variance = made([draws]).predict(states, actions)
    torch.testing.assert_close(mean[:, 1:], states[:, 1:] + draws.mean() * actions)
    expected = Q**2 + actions.square() * draws.var(correction=0)
    torch.testing.assert_close(variance[:, 1:], expected)
    assert torch.equal(mean[:, 0], states[:, 0])
    assert not variance[:, 0].any()
    one = made([draws]).predict(states[0], actions[0])
    torch.testing.assert_close(one.variance, variance[0])
    alone = made([], "x + u", {})
    process = torch.full((30,), Q**2).double()
    torch.testing.assert_close(alone.predict(states, actions).variance[:, 1], process)
    blocks = states.expand(3, -1, -1), actions.expand(3, -1, -1)
    assert alone.sample_functions(3, seed=0)(*blocks).shape == (3, 30, 2)


def test_it_learns_on_as_a_linear_gaussian_model_does():
    dynamics = made([1.0 + 0.2 * normal(4000, seed=3)])
    before = dynamics.physics_parameters["a"]
    states, actions, following = moves()
    dynamics.update(states, actions, following)
    y, u = (following - states)[:, 1], actions[:, 0]
    found = dynamics.physics_parameters
    variance = (y - found.mean * u).square().mean().clamp_min(Q**2 + 2 * R**2)
    precision = 1 / before.var() + u.square().sum() / variance
    mean = (before.mean() / before.var() + (u * y).sum() / variance) / precision
    torch.testing.assert_close(found.mean[0], mean, rtol=1e-4, atol=0)
    torch.testing.assert_close(found.sd[0], precision.rsqrt(), rtol=1e-2, atol=0)


def test_it_is_saved_and_loaded():
    dynamics, other = made([1.0 + 0.2 * normal(9)]), made([torch.ones(3).double()])
    state = dynamics.state_dict()
    other.load_state_dict(state)
    states, actions, _ = moves()
    same(other.predict(states, actions), dynamics.predict(states, actions), rtol=0, atol=0)
    refused(RuntimeError, "unknowns is", made([], "x + u", {}).load_state_dict, state)
    squared = made([torch.ones(3).double()], "x + a * a * u")
    words = r"physics is 'x \+ a \* u' in the state"
    refused(RuntimeError, words, squared.load_state_dict, state)


def test_a_controller_plans_in_it_and_learns_on():
    """The physics of Python, too."""
    physics = FunctionPhysics(lambda X, p: X[:, 0] + p.a * X[:, 1], unknowns={"a": PRIOR})
    draws = PhysicsParameters({"a": PRIOR}, [0.7 + 0.2 * normal(64)])
    noises = [torch.tensor([0.0, 0.01]).double()] * 2
    dynamics = IdentifiedDynamics(SPEC, physics, draws, *noises)
    task = Task(dynamics, lambda states, actions, following: -(following[:, 1] - 1).square())
    controller = MPC(task, [[-0.5], [0.5]], Planner(horizon=3, num_random=32))
    x = 0.0
    for _ in range(8):
        x += 1.3 * float(controller.step([0.0, x])[0])
    controller.observe([0.0, x])
    controller.learn()
    assert abs(x - 1) < 0.1
    assert dynamics.physics_parameters["a"].mean() == pytest.approx(1.3, abs=0.02)


def test_it_predicts_by_the_center_of_a_ridge():
    """Of b and c only the product is known, 2; the mean of b times that of c is far from it."""
    unknowns = {"b": Unknown(1.0, factor=3.0), "c": Unknown(2.0, factor=3.0)}
    b = normal(400).exp()
    dynamics = made([b, 2.0 / b], "x + b * c * u", unknowns)
    assert dynamics.physics_parameters.mean.prod() > 4.0
    center = b.log().mean().exp()
    expected = torch.stack([center, 2.0 / center])
    torch.testing.assert_close(dynamics.physics_parameters.center, expected)
    states, actions, _ = moves()
    mean, variance = dynamics.predict(states, actions)
    torch.testing.assert_close(mean[:, 1:], states[:, 1:] + 2.0 * actions)
    torch.testing.assert_close(variance[:, 1], torch.full((30,), Q**2).double())
    torch.testing.assert_close(dynamics.mean_function()(states[None], actions[None])[0], mean)


def test_a_draw_at_a_bound_has_a_center():
    share = Unknown(0.5, bounds=(0.0, 1.0))
    center = PhysicsParameters({"share": share}, [torch.tensor([0.0, 0.5, 1.0]).double()]).center
    torch.testing.assert_close(center, torch.tensor([0.5]).double())
