"""Dynamics that learn unknown parameters of their physics."""

import pytest
import torch

from gpadjust import CKA, CalibratedPhysics, ODEPhysics, Unknown
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.dynamics.learned_dynamics import TargetPhysics, Targets
from gpadjust.physics import FunctionPhysics
from gpadjust.systems.swing_up import CART_POLE_SPEC, CartPoleEquation, equation_physics
from tests.dynamics.conftest import trial_of
from tests.systems import normal, refused, same, uniform

SPEC = StateSpec(["q", "dq"], ["u"], angles=["q"])
UNKNOWNS = {"k": Unknown(1.0, factor=2.0), "c": Unknown(0.2, bounds=(0.0, 1.0))}
FEW = {"num_draws": 64}


def pendulum(state, action, p):
    rate = -p.k * state[:, 0].sin() - p.c * state[:, 1] + action[:, 0]
    return torch.stack([state[:, 1], rate], -1)


def make_physics(**changes):
    return ODEPhysics(pendulum, 0.1, 2, unknowns={**UNKNOWNS, **changes}, substeps=2)


def make(model=CalibratedPhysics, **changes):
    return LearnedDynamics(SPEC, make_physics(**changes), model=model, fit_options=FEW)


def transitions(n, seed=0):
    """Transitions of a pendulum with k = 1.7 and c = 0.5."""
    rows = uniform(n, 3, low=-2.0, high=2.0, seed=seed)
    truth = make_physics()(rows, torch.tensor([1.7, 0.5], dtype=torch.float64))
    return rows[:, :2], rows[:, 2:], truth + 1e-4 * uniform(n, 2, low=-1.0, seed=seed + 1)


@pytest.mark.slow
@pytest.mark.parametrize("model", [CalibratedPhysics, CKA])
def test_are_learnt_kept_and_used(model):
    dynamics, (states, actions, after) = make(model), transitions(8, seed=5)
    guess = torch.tensor([1.0, 0.2], dtype=torch.float64)
    guessed = make_physics()(torch.cat([states, actions], -1), guess)
    same([dynamics.before_data().predict(states, actions).mean], [guessed])
    dynamics.update(*transitions(12))
    parameters = dynamics.model.physics_parameters
    assert abs(parameters["k"].mean() - 1.7) < 0.1
    assert abs(parameters["c"].mean() - 0.5) < 0.1
    mean, variance = dynamics.predict(states, actions)
    assert (mean - after).abs().max() < 0.01
    assert (variance > 0).any()

    again = make(model)
    again.load_state_dict(dynamics.state_dict())
    same(again.predict(states, actions), dynamics.predict(states, actions))
    assert torch.equal(again.model.physics_parameters.draws, parameters.draws)

    blocks = [t.expand(4, *t.shape) for t in (states, actions)]
    leaf = blocks[0].clone().requires_grad_()
    found = dynamics.sample_functions(4, seed=0)(leaf, blocks[1])
    assert (found - after).abs().max() < 0.01
    (slope,) = torch.autograd.grad(found[..., 0].sum(), leaf)
    torch.testing.assert_close(slope[..., 1], torch.full_like(slope[..., 1], 0.1), rtol=0.2, atol=0)


def test_a_state_of_other_priors_is_refused():
    dynamics = make()
    dynamics.update(*transitions(6))
    other = make(k=Unknown(1.0, factor=1.9))  # the same guess
    words = r"unknowns is \{'c': .*factor=2.0.*factor=1.9.* here"
    refused(RuntimeError, words, other.load_state_dict, dynamics.state_dict())
    assert "unknowns" not in LearnedDynamics(SPEC, lambda X: X[:, :2]).describe()


def test_targets_of_a_physics_at_parameters():
    calls = []

    def turn(X, p):
        """NaN where it turns too far."""
        calls.append(len(X))
        moved = X[:, :2] + p.speed[:, None]
        return moved.where(p.speed[:, None] < 5.0, torch.nan)

    physics = FunctionPhysics(turn, unknowns={"speed": Unknown(1.0, sd=1.0)})
    targets = TargetPhysics(physics, Targets(SPEC, "difference"))
    X = uniform(4, 3, low=-3.0, high=3.0)
    speed = torch.tensor([[0.5], [4.0], [-4.0]], dtype=torch.float64)
    pi = torch.pi
    rows = [[0.5, 0.5], [4 - 2 * pi, 4.0], [2 * pi - 4, -4.0]]
    expected = torch.tensor(rows, dtype=torch.float64)
    for found in (targets(X, speed), targets.or_nan(X, speed)):
        torch.testing.assert_close(found, expected.unsqueeze(-2).expand(3, 4, 2))
    torch.testing.assert_close(targets(X, speed[0]), expected[0].expand(4, 2))
    calls.clear()
    found = targets.or_nan(X, torch.tensor([[0.5], [9.0]], dtype=torch.float64))
    assert found.isnan().all(-1).all(-1).tolist() == [False, True]
    torch.testing.assert_close(found[0], expected[0].expand(4, 2))
    assert calls == [8]  # at once, although some fail


def test_a_failure_in_a_column_that_is_not_predicted_is_one():
    spec = StateSpec(["x", "v"], ["a"], integrated={"x": "v"}, step=0.1)
    physics = FunctionPhysics(lambda X: torch.stack([(-X[:, 0]).sqrt(), X[:, 1]], -1))
    X = torch.tensor([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]], dtype=torch.float64)
    found = TargetPhysics(physics, Targets(spec, "difference")).or_nan(X)
    assert found.isnan().tolist() == [[True], [False]]


# A cart-pole whose masses, length and friction are unknown, after one trial

MASSES = {
    "cart_mass": Unknown(0.6, factor=1.5, unit="kg"),
    "pole_mass": Unknown(0.6, factor=1.5, unit="kg"),
    "pole_length": Unknown(0.7, factor=1.5, unit="m"),
    "damping": Unknown(0.05, bounds=(0.0, 1.0), unit="N s/m"),
}
NOISE = 0.01  # m, rad, m/s, rad/s


def cart_pole():
    return equation_physics(CartPoleEquation(0.6, 0.6, 0.7, 0.05), unknowns=MASSES)


def trial(seed, noise=0.0):
    """Transitions under random forces, with noise of the sensors."""
    path, actions = trial_of(seed, 25)
    path = path + noise * normal(26, 4, seed=seed)
    return path[:-1], actions, path[1:]


def learnt_from(data, model):
    dynamics = LearnedDynamics(CART_POLE_SPEC, cart_pole(), model=model, fit_options=FEW)
    dynamics.update(*data)
    return dynamics


def error(dynamics):
    """Of single steps that were not seen, relative to the change of each state."""
    trials = [trial(100 + i) for i in range(4)]
    states, actions, after = (torch.cat(part) for part in zip(*trials, strict=True))
    missed = CART_POLE_SPEC.change(after, dynamics.predict(states, actions).mean)
    return (missed.square().mean(0) / (after - states).square().mean(0)).sqrt().mean().item()


@pytest.mark.slow
def test_one_trial_without_noise_tells_the_parameters():
    dynamics = learnt_from(trial(0), CalibratedPhysics)
    assert error(dynamics) < 1e-4
    truth = torch.tensor([0.5, 0.5, 0.6, 0.1], dtype=torch.float64)
    found = dynamics.model.physics_parameters.mean
    torch.testing.assert_close(found, truth, rtol=1e-3, atol=0)


@pytest.mark.slow
def test_with_noise_it_is_as_good_as_least_squares():
    data = trial(0, NOISE)
    fitted = PhysicsDynamics(CART_POLE_SPEC, cart_pole())
    fitted.update(*data)
    assert error(learnt_from(data, CalibratedPhysics)) < 1.5 * error(fitted)
    assert error(learnt_from(data, CKA)) < 2 * error(fitted)
