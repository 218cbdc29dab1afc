"""How dynamics go on learning, and are stored."""

import io
import warnings

import pytest
import torch
from botorch.models.transforms.outcome import Standardize

from gpadjust import fit
from gpadjust.inference.warm_start import warm_start

pytestmark = pytest.mark.filterwarnings(
    "ignore:f_p is nearly zero", "ignore::gpadjust.inference.SamplingWarning"
)


def stored(dynamics):
    file = io.BytesIO()
    torch.save(dynamics.state_dict(), file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def agree(first, second, states, actions):
    pairs = zip(first.predict(states, actions), second.predict(states, actions), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.slow
def test_loaded_dynamics_go_on_bit_by_bit(cart_pole_system, make, costly_kind):
    system, kind = cart_pole_system, costly_kind
    dynamics, other = (make(kind, system.spec, system.crude) for _ in range(2))
    for seed in (0, 1):
        dynamics.update(*system.trial(seed, 12))
    other.load_state_dict(stored(dynamics))
    test = system.trial(9)[:2]
    assert agree(dynamics, other, *test)
    for each in (dynamics, other):
        each.condition(*(t[:1] for t in system.trial(2)))
    assert agree(dynamics, other, *test)
    other = make(kind, system.spec, system.crude)
    other.load_state_dict(stored(dynamics))
    assert agree(dynamics, other, *test)
    for each in (dynamics, other):
        each.update(*system.trial(3, 12))
    assert agree(dynamics, other, *test)
    assert other.num_transitions == 37


@pytest.mark.slow
def test_conditioning_is_the_exact_posterior(cart_pole_system, make):
    system = cart_pole_system
    dynamics = make("CKA", system.spec, system.crude)
    first, second = system.trial(0), system.trial(1)
    dynamics.update(*first)
    before = [p.clone() for p in dynamics.model.parameters()]
    dynamics.condition(*second)
    assert all(map(torch.equal, dynamics.model.parameters(), before))
    assert dynamics.num_transitions == 50
    whole = make("CKA", system.spec, system.crude)
    whole.update(*(torch.cat(pair) for pair in zip(first, second, strict=True)))
    state = {**whole.state_dict(), "model": dynamics.state_dict()["model"]}
    whole.load_state_dict(state)
    test = system.trial(9)[:2]
    for one, other in zip(dynamics.predict(*test), whole.predict(*test), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-7)


@pytest.mark.slow
def test_refits_are_quiet_and_leave_the_generator_alone(cart_pole_system, make):
    system = cart_pole_system
    dynamics = make("CKA", system.spec, system.crude)
    state = torch.get_rng_state()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(3):
            dynamics.update(*system.trial(seed))
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.slow
def test_a_warm_start_is_the_same_in_the_users_units(cart_pole_system, make):
    system = cart_pole_system
    dynamics = make("CKA", system.spec, system.crude, fit_options={"method": "map"})
    states, actions, next_states = system.trial(0)
    next_states = next_states + 0.01 * torch.randn_like(next_states)
    dynamics.update(states, actions, next_states)
    before = dynamics.predict(states, actions)
    model = dynamics._recipe.build(dynamics._learnt.data, quiet=True)
    again = type(model)(
        dynamics.targets.inputs(states, actions),
        dynamics.targets.encode(states, next_states),
        physics=dynamics._recipe.physics,
        outcome_transform=Standardize(m=4),
        input_transform=model.input_transform.base,
    )
    warm_start(again, dynamics.model)
    mean, variance = again.eval().predict(
        dynamics.targets.inputs(states, actions), observation_noise=True
    )
    torch.testing.assert_close(states + mean, before.mean, rtol=0, atol=1e-7)
    torch.testing.assert_close(variance, before.variance, rtol=1e-2, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 100])
def test_refits_come_near_what_a_search_reaches(cart_pole_system, make, first):
    system = cart_pole_system
    dynamics = make("CKA", system.spec, system.crude, fit_options={"method": "map"})
    for seed in range(first, first + 8):
        dynamics.update(*system.trial(seed))
    reached = dynamics.fit_result.log_likelihood.sum()
    cold = dynamics._recipe.build(dynamics._learnt.data, quiet=True)
    best = fit(cold, "map").log_likelihood.sum()
    units = (dynamics.model.outcome_transform.stdvs - cold.outcome_transform.stdvs).abs().max()
    assert units < 1e-12
    assert reached > best - 3e-2 * best.abs()
