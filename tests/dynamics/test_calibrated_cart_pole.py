"""A cart-pole whose masses, length and friction are unknown, after one trial."""

import numpy as np
import pytest
import torch

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, Unknown
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics
from gpadjust.systems.swing_up import CART_POLE_SPEC, CartPoleEquation, equation_physics
from tests.dynamics.conftest import trial_of
from tests.systems import normal

UNKNOWNS = {
    "cart_mass": Unknown(0.6, factor=1.5, unit="kg"),
    "pole_mass": Unknown(0.6, factor=1.5, unit="kg"),
    "pole_length": Unknown(0.7, factor=1.5, unit="m"),
    "damping": Unknown(0.05, bounds=(0.0, 1.0), unit="N s/m"),
}
FEW = {"num_draws": 64}
NOISE = 0.01  # m, rad, m/s, rad/s


def physics():
    return equation_physics(CartPoleEquation(0.6, 0.6, 0.7, 0.05), unknowns=UNKNOWNS)


def trial(seed, noise=0.0):
    """Transitions under random forces, with noise of the sensors."""
    path, actions = trial_of(seed, 25)
    path = path + noise * normal(26, 4, seed=seed)
    return path[:-1], actions, path[1:]


def error(dynamics):
    """Of single steps that were not seen, relative to the change of each state."""
    trials = [trial(100 + i) for i in range(4)]
    states, actions, after = (torch.cat(part) for part in zip(*trials, strict=True))
    missed = CART_POLE_SPEC.change(after, dynamics.predict(states, actions).mean)
    return (missed.square().mean(0) / (after - states).square().mean(0)).sqrt().mean().item()


@pytest.mark.slow
@pytest.mark.parametrize("model", [CalibratedPhysics, PhysicsMeanGP, CKA])
def test_one_trial_without_noise_tells_the_parameters(model):
    dynamics = LearnedDynamics(CART_POLE_SPEC, physics(), model=model, fit_options=FEW)
    dynamics.update(*trial(0))
    assert error(dynamics) < 1e-4
    truth = torch.tensor([0.5, 0.5, 0.6, 0.1], dtype=torch.float64)
    found = dynamics.model.physics_parameters.mean
    torch.testing.assert_close(found, truth, rtol=1e-3, atol=0)


@pytest.mark.slow
def test_with_noise_it_is_as_good_as_least_squares():
    errors = {name: [] for name in ("least squares", "calibrated", "delta", "rho and delta")}
    for seed in range(2):
        data = trial(seed, NOISE)
        fitted = PhysicsDynamics(CART_POLE_SPEC, physics())
        fitted.update(*data)
        errors["least squares"].append(error(fitted))
        models = (CalibratedPhysics, PhysicsMeanGP, CKA)
        for name, model in zip([*errors][1:], models, strict=True):
            dynamics = LearnedDynamics(CART_POLE_SPEC, physics(), model=model, fit_options=FEW)
            dynamics.update(*data)
            errors[name].append(error(dynamics))
    means = {name: np.mean(values) for name, values in errors.items()}
    assert means["calibrated"] < 1.5 * means["least squares"]
    assert means["delta"] < 1.5 * means["least squares"]
    assert means["rho and delta"] < 2 * means["least squares"]
