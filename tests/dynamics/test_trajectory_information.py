"""What a trajectory would teach, against linear algebra and by what information is."""

import math

import pytest
import torch

from gpadjust import ZeroMeanGP
from gpadjust.active import qAdjustmentInformationGain
from gpadjust.dynamics import (
    LearnedDynamics,
    PhysicsDynamics,
    StateSpec,
    TrajectoryInformation,
)
from gpadjust.models import PaperRRA

SEARCH = {"num_starts": 1, "num_screened": 0, "max_iterations": 15}
QUICK = {"fit_options": {"method": "map", **SEARCH}}
pytestmark = pytest.mark.filterwarnings("ignore:L-BFGS did not converge")


@pytest.fixture
def learnt(cart_pole_system, make):
    """Makes dynamics of a class that have learnt a trial of the cart-pole."""

    def learnt(kind, **options):
        options = QUICK | options
        dynamics = make(kind, cart_pole_system.spec, cart_pole_system.crude, **options)
        dynamics.update(*cart_pole_system.trial(0))
        return dynamics

    return learnt


@pytest.fixture
def trajectory(cart_pole_system):
    """The states and actions of another trial of the cart-pole."""
    states, actions, _ = cart_pole_system.trial(1, num_steps=6)
    return states, actions


def dense(dynamics, states, actions, learnt_from):
    """The information from whole covariance matrices, output by output."""
    model = dynamics.model
    X = torch.cat([dynamics.targets.inputs(*learnt_from), dynamics.targets.inputs(states, actions)])
    with torch.no_grad():
        prior = model.covar_module(model.transform_inputs(X).unsqueeze(-3)).to_dense()
    noise = model.likelihood.noise.detach()
    n, total = len(learnt_from[0]), 0.0
    for K, variance in zip(prior, noise.reshape(-1), strict=True):
        known = K[:n, :n] + variance * torch.eye(n)
        posterior = K[n:, n:] - K[n:, :n] @ torch.linalg.solve(known, K[:n, n:])
        total += torch.logdet(torch.eye(len(posterior)) + posterior / variance) / 2
    return total


@pytest.mark.parametrize("kind", ["CKA", "GP", "PhysicsMean", "RRA"])
def test_it_is_that_of_linear_algebra(learnt, trajectory, cart_pole_system, kind):
    dynamics = learnt(kind)
    found = TrajectoryInformation(dynamics)(*trajectory)
    expected = dense(dynamics, *trajectory, cart_pole_system.trial(0)[:2])
    assert found > 1
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")
@pytest.mark.parametrize("method", [{"method": "map"}, {"num_draws": 64}], ids=["map", "bayes"])
def test_of_cka_it_is_the_information_about_rho_and_delta(learnt, trajectory, method):
    options = {"fit_options": SEARCH | method, "model_options": {"rho_mean": "learn"}}
    dynamics = learnt("CKA", **options)
    with torch.no_grad():
        expected = qAdjustmentInformationGain(dynamics.model, "both")(
            dynamics.targets.inputs(*trajectory)
        )
    torch.testing.assert_close(
        TrajectoryInformation(dynamics)(*trajectory), expected.mean(), rtol=1e-9, atol=1e-9
    )


def test_a_single_output():
    x, v = torch.rand(2, 9, 1, dtype=torch.float64)
    dynamics = LearnedDynamics(StateSpec(["x"], ["v"]), **QUICK, model=ZeroMeanGP)
    dynamics.update(x, v, x + 0.1 * v.sin() + 0.02 * torch.randn_like(x))
    states, actions = 3 * torch.rand(2, 4, 3, 1, dtype=torch.float64)
    information = TrajectoryInformation(dynamics)
    found = information(states, actions)
    assert found.shape == (4,)
    torch.testing.assert_close(found[1], dense(dynamics, states[1], actions[1], (x, v)))
    _, variance = dynamics.predict(states[0, :1], actions[0, :1], observation_noise=False)
    noise = dynamics.predict(states[0, :1], actions[0, :1]).variance - variance
    one = information(states[0, :1], actions[0, :1])
    torch.testing.assert_close(one, (1 + variance / noise).log().sum() / 2)


def test_trajectories_are_asked_side_by_side(learnt, cart_pole_system, monkeypatch):
    trials = [cart_pole_system.trial(seed, num_steps=5) for seed in range(1, 7)]
    states, actions = (torch.stack([trial[i] for trial in trials]) for i in range(2))
    information = TrajectoryInformation(learnt("CKA"))
    one_by_one = torch.stack([information(s, a) for s, a in zip(states, actions, strict=True)])
    torch.testing.assert_close(information(states, actions), one_by_one)
    monkeypatch.setattr("gpadjust.dynamics.trajectory_information._CHUNK", 12)
    blocks = information(states.reshape(2, 3, 5, 4), actions.reshape(2, 3, 5, 1))
    torch.testing.assert_close(blocks, one_by_one.reshape(2, 3))


def test_the_order_of_the_steps_does_not_matter(learnt, trajectory):
    information = TrajectoryInformation(learnt("CKA"))
    order = torch.tensor([4, 0, 5, 2, 1, 3])
    torch.testing.assert_close(
        information(*(part[order] for part in trajectory)), information(*trajectory)
    )


def test_a_trajectory_made_twice_teaches_less_than_two(learnt, trajectory):
    information = TrajectoryInformation(learnt("GP"))
    once = information(*trajectory)
    twice = information(*(torch.cat([part, part]) for part in trajectory))
    assert once < twice < 1.5 * once


def test_the_chain_rule(learnt, cart_pole_system, trajectory):
    dynamics = learnt("CKA")
    whole = TrajectoryInformation(dynamics)(*trajectory)
    first = TrajectoryInformation(dynamics)(*(part[:2] for part in trajectory))
    states, actions, following = cart_pole_system.trial(1, num_steps=6)
    dynamics.condition(states[:2], actions[:2], following[:2])
    rest = TrajectoryInformation(dynamics)(*(part[2:] for part in trajectory))
    torch.testing.assert_close(first + rest, whole, rtol=1e-6, atol=1e-6)


def test_what_was_measured_many_times_teaches_nearly_nothing(learnt, cart_pole_system, trajectory):
    dynamics = learnt("CKA")
    before = TrajectoryInformation(dynamics)(*trajectory)
    states, actions, following = cart_pole_system.trial(1, num_steps=6)
    gains = []
    for copies in (1, 100):
        dynamics.condition(*(part.repeat(copies, 1) for part in (states, actions, following)))
        gains.append(TrajectoryInformation(dynamics)(*trajectory))
    assert gains[1] < gains[0] < before
    # Of a function that was measured 101 times, each of 6 points has a variance of noise / 101.
    assert gains[1] <= 4 * 6 * math.log1p(1 / 101) / 2
    assert gains[1] > 0


def test_steps_that_are_not_made_tell_nothing(learnt, trajectory):
    information = TrajectoryInformation(learnt("CKA"))
    counted = torch.tensor([True, True, False, True, False, False])
    torch.testing.assert_close(
        information(*trajectory, counted), information(*(part[counted] for part in trajectory))
    )
    assert information(*trajectory, torch.zeros(6, dtype=torch.bool)) == 0


def test_later_updates_do_not_count(learnt, cart_pole_system, trajectory):
    dynamics = learnt("CKA")
    information = TrajectoryInformation(dynamics)
    before = information(*trajectory)
    dynamics.update(*cart_pole_system.trial(1))
    torch.testing.assert_close(information(*trajectory), before, rtol=1e-10, atol=0.0)
    assert TrajectoryInformation(dynamics)(*trajectory) < before


def test_dynamics_that_cannot_tell(cart_pole_system):
    spec, crude = cart_pole_system.spec, cart_pole_system.crude
    with pytest.raises(TypeError, match=r"Expected LearnedDynamics.* found PhysicsDynamics"):
        TrajectoryInformation(PhysicsDynamics(spec, crude))
    with pytest.raises(RuntimeError, match="LearnedDynamics has not learnt"):
        TrajectoryInformation(LearnedDynamics(spec, crude))
    with pytest.raises(TypeError, match="take model=RRA"):
        TrajectoryInformation(LearnedDynamics(spec, crude, model=PaperRRA))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s, a: (s[:, :3], a), r"states of shape \.\.\. x 4"),
        (lambda s, a: (s, a.repeat(1, 2)), r"actions of shape \.\.\. x 1"),
        (lambda s, a: (s[:3], a), r"got \(3, 4\) and \(6, 1\)"),
        (lambda s, a: (s[0], a[0]), r"got \(4,\) and \(1,\)"),
        (lambda s, a: (s, a, torch.ones(6)), r"booleans of shape \(6,\).*got torch.float32"),
        (lambda s, a: (s, a, torch.ones(5, dtype=torch.bool)), r"of shape \(5,\)"),
    ],
)
def test_other_shapes_are_refused(learnt, trajectory, change, message):
    information = TrajectoryInformation(learnt("GP"))
    with pytest.raises(ValueError, match=message):
        information(*change(*trajectory))
