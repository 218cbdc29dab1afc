"""Dynamics that are physics alone."""

from functools import partial

import pytest
import torch

from gpadjust import ZeroMeanGP
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import ODEPhysics
from tests.dynamics.conftest import FEW, push
from tests.dynamics.conftest import PUSHED as SPEC
from tests.dynamics.conftest import pushed as transitions
from tests.systems import refused


def test_it_predicts_the_physics_without_doubt():
    dynamics = PhysicsDynamics(SPEC, push)
    assert dynamics.is_fitted
    states, actions, following = transitions()
    dynamics.update(states, actions, following)
    mean, variance = dynamics.predict(states, actions)
    assert not variance.any()
    for found in (mean, dynamics.sample(states, actions)):
        assert torch.equal(found, following)
    blocks = dynamics.sample_functions(2)(states.view(2, 10, 2), actions.view(2, 10, 1))
    assert torch.equal(blocks, following.view(2, 10, 2))


class Wider(Dynamics):
    """A user's own: push, and a doubt about the velocity."""

    is_fitted = True
    update = sample_functions = None

    def predict(self, states, actions):
        mean = push(torch.cat([states, actions], -1))
        return mean, torch.tensor([0.0, 0.04], dtype=torch.float64).expand_as(mean)


def test_all_dynamics_are_scored():
    states, actions, following = transitions()
    following = following + 0.1
    following[3] = torch.tensor([0.0, torch.nan])
    for dynamics in (PhysicsDynamics(SPEC, push), Wider(SPEC)):
        scores = dynamics.score(states, actions, following)
        torch.testing.assert_close(scores.rmse[1], torch.tensor(0.1).double())
        assert scores.rmse[0] > 0.1
        doubts = [False, isinstance(dynamics, Wider)]  # a variance of zero says nothing
        assert scores.nlpd.isfinite().tolist() == scores.coverage.isfinite().tolist() == doubts
    density = torch.distributions.Normal(0, 0.2).log_prob(torch.tensor(0.1)).double()
    torch.testing.assert_close(scores.nlpd[1], -density)
    assert scores.coverage[1] == 1


def test_states_that_are_not_as_declared_are_named():
    for make, declared, words in (
        (PhysicsDynamics, {"previous": {"x": "a"}}, "'x' is declared as the previous action 'a'"),
        (LearnedDynamics, {"exogenous": ["x"]}, "'x' is declared as exogenous"),
    ):
        dynamics = make(StateSpec(["x", "v"], ["a"], **declared), push)
        refused(ValueError, words, dynamics.update, *transitions())


@pytest.mark.parametrize("kind", [PhysicsDynamics, partial(LearnedDynamics, fit_options=FEW)])
def test_a_physics_of_differences_is_warned_of(kind):
    dynamics = kind(SPEC, lambda X: push(X) - X[:, :2])
    with pytest.warns(UserWarning, match="seems to return the change of the state"):
        dynamics.update(*transitions())
    dynamics.update(*transitions(seed=1))  # no second warning, which would be an error here


@pytest.mark.parametrize("scale", [0.5, 3.0])
def test_a_crude_physics_of_next_states_is_not_warned_of(scale):
    crude = PhysicsDynamics(SPEC, lambda X: X[:, :2] + scale * (push(X) - X[:, :2]))
    crude.update(*transitions())


TIMED = StateSpec(["x", "v"], ["push"], step=0.1)
FAST = ODEPhysics(lambda x, a: x, 0.05, 2)
REFUSED = [
    (TypeError, "spec must be a StateSpec", PhysicsDynamics, ["x", "v"], push),
    (ValueError, r"steps of 0.05, but .* has 0.1; .*step=0\.1", PhysicsDynamics, TIMED, FAST),
    (ValueError, "Expected one physics to follow", PhysicsDynamics, SPEC, [push, push]),
]


def test_bad_input_is_refused():
    for error, words, *call in REFUSED:
        refused(error, words, *call)
    dynamics = PhysicsDynamics(SPEC, lambda X: X)
    words = r"next values of the 2 states .*got 3 columns"
    refused(ValueError, words, dynamics.predict, *transitions()[:2])


@pytest.mark.slow
def test_a_state_of_others_is_refused():
    learnt = LearnedDynamics(SPEC, push, fit_options=FEW)
    learnt.update(*transitions())
    integrated = StateSpec(["x", "v"], ["a"], integrated={"x": "v"}, step=0.1)
    for other, words in (
        (LearnedDynamics(SPEC, model=ZeroMeanGP), "model is CKA in the state, ZeroMeanGP here"),
        (PhysicsDynamics(SPEC, push), "class is LearnedDynamics in the state"),
        (LearnedDynamics(SPEC, push, target="absolute"), "target is 'difference' in the state"),
        (LearnedDynamics(StateSpec(["y", "v"], ["a"]), push), r"states is \('x', 'v'\)"),
        (LearnedDynamics(integrated, push), "integrated is"),
    ):
        refused(RuntimeError, words, other.load_state_dict, learnt.state_dict())
        assert isinstance(other, PhysicsDynamics) or not other.is_fitted
