"""Trajectories of which some entries of the next states were not measured."""

import math

import pytest
import torch

from gpadjust import ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics, StateSpec
from tests.systems import refused, same

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


@pytest.mark.slow
def test_each_state_is_learnt_from_its_own_rows(cart_pole_system, make, costly_kind, holed):
    system, test = cart_pole_system, cart_pole_system.trial(9)[:2]
    dynamics = make(costly_kind, system.spec, system.crude)
    dynamics.update(*holed)
    inputs = dynamics.targets.inputs(*test)
    for column in range(4):
        known = ~holed[2][:, column].isnan()
        alone = dynamics.model.subset_rows(known.nonzero().flatten())
        ours, theirs = (
            [part[:, column] for part in model.predict(inputs)] for model in (alone, dynamics.model)
        )
        same(ours, theirs, rtol=1e-4, atol=1e-7)


def test_a_state_that_is_measured_once_is_refused(cart_pole_system, make):
    states, actions, following = cart_pole_system.trial(0)
    following = torch.cat([following[:, :3], torch.full_like(actions, math.nan)], -1)
    following[0, 3] = 0.0
    update = make("GP", cart_pole_system.spec, None).update
    refused(ValueError, "from, got 1 with a measured 'omega'", update, states, actions, following)


def test_a_row_of_nothing_is_refused(cart_pole_system, learnt_cart_pole, make, holed):
    system, dynamics = cart_pole_system, learnt_cart_pole
    holed[2][11] = math.nan
    new = make("CKA", system.spec, system.crude)
    for call in (new.update, dynamics.update, dynamics.score):
        refused(ValueError, r"observation in each row.*\(row 11\)", call, *holed)
    assert dynamics.num_transitions == 25
    partly = LearnedDynamics(StateSpec(["x", "v"], ["a"], exogenous=["x"]), model=ZeroMeanGP)
    following = torch.tensor([[1.0, 2.0], [1.0, math.nan]]).double()  # all that a model predicts
    words = r"predicted entries of next_states.*row 1"
    refused(ValueError, words, partly.update, following.nan_to_num(), following[:, :1], following)
