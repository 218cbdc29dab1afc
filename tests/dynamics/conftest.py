"""A cart-pole, its crude physics, and dynamics of every model."""

import math
from functools import cache, partial

import pytest
import torch

from gpadjust import CKA, RRA, ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics, StateSpec
from gpadjust.systems.swing_up import CartPoleEquation, equation_physics
from tests.systems import uniform

TRUTH = equation_physics(CartPoleEquation(0.5, 0.5, 0.6, 0.1))


@cache
def trial_of(seed, num_steps):
    """The states and the actions of a trial, made once for all tests."""
    generator = torch.Generator().manual_seed(seed)
    start = 0.2 * torch.randn(1, 4, generator=generator, dtype=torch.float64)
    states = [start + torch.tensor([0, math.pi, 0, 0])]
    actions = 20 * torch.rand(num_steps, 1, generator=generator, dtype=torch.float64) - 10
    for action in actions.split(1):
        states.append(TRUTH(torch.cat([states[-1], action], -1)))
    return torch.cat(states), actions


class CartPole:
    spec = StateSpec(["x", "theta", "v", "omega"], ["force"], angles=["theta"])
    truth = staticmethod(TRUTH)
    crude = staticmethod(equation_physics(CartPoleEquation(0.45, 0.6, 0.65, 0.0)))

    def trial(self, seed, num_steps=25):
        """A trial of random actions from hanging: states, actions, next states."""
        path, actions = (t.clone() for t in trial_of(seed, num_steps))
        return path[:-1], actions, path[1:]


@pytest.fixture
def cart_pole_system():
    return CartPole()


PUSHED = StateSpec(["x", "v"], ["a"])


def push(X, strength=0.1):
    """The next position and velocity of what is pushed."""
    x, v, a = X.split(1, -1)
    return torch.cat([x + 0.1 * v, v + strength * a], -1)


def pushed(n=20, seed=0):
    """Transitions of it."""
    X = uniform(n, 3, seed=seed) + 1
    return X[:, :2], X[:, 2:], push(X)


FEW = {"num_draws": 8}
_MODELS = {"GP": ZeroMeanGP, "CKA": CKA, "RRA": RRA}


@pytest.fixture(params=["GP", "CKA", pytest.param("RRA", marks=pytest.mark.slow)])
def costly_kind(request):
    """The name of a model without a physics, with one, and with random features, for `make`."""
    return request.param


@pytest.fixture
def make():
    """Makes dynamics by the name of their model, with few draws."""

    def make(kind, spec, physics, **options):
        options.setdefault("fit_options", FEW)
        model = options.pop("model", _MODELS[kind])
        if kind == "RRA":
            model = partial(model, num_features=32)
        return LearnedDynamics(spec, None if kind == "GP" else physics, model=model, **options)

    return make


@pytest.fixture(scope="session")
def learnt_cart_pole():
    """CKA that has learnt from trial 1 of the cart-pole, for tests that only look at it."""
    system = CartPole()
    dynamics = LearnedDynamics(system.spec, system.crude, fit_options=FEW)
    dynamics.update(*system.trial(1))
    return dynamics
