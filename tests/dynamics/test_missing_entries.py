"""Trajectories of which some entries of the next states were not measured."""

import math

import pytest
import torch

from gpadjust import ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics, StateSpec

pytestmark = pytest.mark.filterwarnings(
    "ignore:f_p is nearly zero", "ignore::gpadjust.core.SamplingWarning"
)


@pytest.fixture
def holed(cart_pole_system):
    """A trial without angles in two rows, and without all but the position in one."""
    states, actions, next_states = (t.clone() for t in cart_pole_system.trial(0))
    next_states[[2, 9], 1] = math.nan
    next_states[4, 1:] = math.nan
    return states, actions, next_states


def assert_same(found, expected, columns=slice(None), **tolerance):
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one[..., columns], other[..., columns], **tolerance)


@pytest.mark.slow
def test_each_state_is_learnt_from_its_own_rows(cart_pole_system, make, costly_kind, holed):
    system, test, kind = cart_pole_system, cart_pole_system.trial(9)[:2], costly_kind
    dynamics = make(kind, system.spec, system.crude)
    dynamics.update(*holed)
    inputs = dynamics.targets.inputs(*test)
    for column in range(4):
        known = ~holed[2][:, column].isnan()
        alone = dynamics.model.subset_rows(known.nonzero().flatten())
        pair = (alone.predict(inputs), dynamics.model.predict(inputs))
        assert_same(*pair, column, rtol=1e-4, atol=1e-7)


def test_scores_are_over_what_was_measured(cart_pole_system, learnt_cart_pole, holed):
    system, dynamics = cart_pole_system, learnt_cart_pole
    scores = dynamics.score(*holed)
    for column in range(4):
        known = ~holed[2][:, column].isnan()
        whole = dynamics.score(*(t[known] for t in system.trial(0)))
        names = ("rmse", "median", "nlpd", "crps", "coverage")
        pairs = [[getattr(each, name) for name in names] for each in (scores, whole)]
        assert_same(*pairs, column)


@pytest.mark.slow
def test_a_state_that_is_seldom_measured(cart_pole_system, make):
    system = cart_pole_system
    trials = [system.trial(seed) for seed in range(8)]
    states, actions, next_states = (torch.cat(parts) for parts in zip(*trials, strict=True))
    next_states[1:150, 3] = next_states[151:, 3] = math.nan
    dynamics = make("GP", system.spec, None)
    dynamics.update(*(t[:2] for t in trials[0]))
    dynamics.update(states, actions, next_states)  # searches on some of the rows
    assert dynamics.score(*system.trial(9)).rmse.isfinite().all()
    with pytest.raises(ValueError, match="from, got 1 with a measured 'omega'"):
        make("GP", system.spec, None).update(states[:150], actions[:150], next_states[:150])


def test_a_row_of_nothing_is_refused(cart_pole_system, learnt_cart_pole, make, holed):
    system, dynamics = cart_pole_system, learnt_cart_pole
    holed[2][11] = math.nan
    new = make("CKA", system.spec, system.crude)
    for call in (new.update, dynamics.update, dynamics.score):
        with pytest.raises(ValueError, match=r"observation in each row.*\(row 11\)"):
            call(*holed)
    assert dynamics.num_transitions == 25


def test_declared_states_are_checked_where_they_were_measured():
    spec = StateSpec(["q", "v", "goal"], ["a"], integrated={"q": "v"}, step=0.1, exogenous=["goal"])
    states = torch.rand(8, 3, dtype=torch.float64)
    actions = torch.rand(8, 1, dtype=torch.float64)
    following = states.clone()
    following[:, 1] += 0.1 * actions[:, 0]
    following[:, 0] += 0.05 * (states[:, 1] + following[:, 1])
    following[1, 0] = following[2, 2] = math.nan
    dynamics = LearnedDynamics(spec, model=ZeroMeanGP)
    dynamics.update(states, actions, following)
    wrong = following.clone()
    wrong[:, 0] = states[:, 0] + 3 * (following[:, 0] - states[:, 0])
    with pytest.raises(ValueError, match="'q' is declared as integrated"):
        dynamics.update(states, actions, wrong)
    wrong = following.clone()
    wrong[5, 2] += 1
    with pytest.raises(ValueError, match=r"'goal' is declared as exogenous.*row 5"):
        dynamics.update(states, actions, wrong)
    following[6, 1] = math.nan  # all that the model predicts
    with pytest.raises(ValueError, match=r"predicted entries of next_states.*row 6"):
        dynamics.update(states, actions, following)
