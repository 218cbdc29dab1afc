"""How dynamics go on learning, and are stored."""

import io
import warnings

import pytest
import torch

pytestmark = pytest.mark.filterwarnings(
    "ignore:f_p is nearly zero", "ignore::gpadjust.core.SamplingWarning"
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
        each.update(*system.trial(3, 12))
    assert agree(dynamics, other, *test)
    assert other.num_transitions == 36


@pytest.mark.slow
def test_refits_are_quiet_and_leave_the_generator_alone(cart_pole_system, make):
    system = cart_pole_system
    dynamics = make("CKA", system.spec, system.crude, fit_options=None)
    state = torch.get_rng_state()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(3):
            dynamics.update(*system.trial(seed))
    assert torch.equal(torch.get_rng_state(), state)
