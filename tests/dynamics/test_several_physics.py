"""Dynamics of several physics."""

import pytest
import torch

from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics
from tests.dynamics.conftest import PUSHED, push, pushed

pytestmark = pytest.mark.filterwarnings(
    "ignore:f_p is nearly zero", "ignore::gpadjust.core.SamplingWarning"
)
POINT_FIT = {"method": "map"}


@pytest.fixture
def still():
    """A second physics: nothing moves but by its velocity."""
    return lambda X: X[:, :4] + 0.1 * torch.cat([X[:, 2:4], torch.zeros_like(X[:, 2:4])], -1)


@pytest.mark.slow
def test_random_features_take_several(cart_pole_system, make, still):
    system = cart_pole_system
    dynamics = make("RRA", system.spec, {"rod": system.crude, "still": still})
    dynamics.update(*system.trial(0))
    assert dynamics.score(*system.trial(1)).rmse.isfinite().all()
    assert "rho_rod" in [term.name for term in dynamics.model.terms]
    blocks = (part[:3].expand(2, -1, -1) for part in system.trial(1)[:2])
    assert dynamics.sample_functions(2, seed=0)(*blocks).shape == (2, 3, 4)


def test_the_better_physics_gets_the_weight(cart_pole_system, make, still):
    system = cart_pole_system
    dynamics = make("CKA", system.spec, {"still": still, "truth": system.truth})
    dynamics.update(*system.trial(0))
    states, actions, next_states = system.trial(1)
    mean = dynamics.predict(states, actions).mean
    torch.testing.assert_close(mean, next_states, rtol=0, atol=1e-4)
    rho = dynamics.model.term("rho_truth", dynamics.targets.inputs(states, actions)).mean
    torch.testing.assert_close(rho, torch.ones_like(rho), rtol=0, atol=1e-3)


def test_a_state_is_of_the_same_physics_in_the_same_order(make):
    parts = {"push": push, "still": lambda X: X[:, :2]}
    dynamics = make("CKA", PUSHED, parts, fit_options=POINT_FIT)
    dynamics.update(*pushed(8))
    swapped = make("CKA", PUSHED, dict([*parts.items()][::-1]), fit_options=POINT_FIT)
    with pytest.raises(RuntimeError, match="physics is"):
        swapped.load_state_dict(dynamics.state_dict())


def test_each_part_is_checked(cart_pole_system, make, still):
    system = cart_pole_system
    assert PhysicsDynamics(system.spec, {"still": still}).is_fitted
    parts = {"rod": system.crude, "late": lambda X: system.crude(X) - X[:, :4]}
    with pytest.warns(UserWarning, match="'late' seems to return the change"):
        make("CKA", system.spec, parts, fit_options=POINT_FIT).update(*system.trial(0))
    dynamics = LearnedDynamics(system.spec, [system.crude, lambda X: X[:, :3]])
    with pytest.raises(ValueError, match="next values of the 4 states"):
        dynamics.update(*system.trial(0))
