"""Slopes and variances of dynamics near some states."""

import torch

from gpadjust import ZeroMeanGP
from gpadjust.dynamics import LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.dynamics.linearised import linearised
from tests.systems import normal

SPEC = StateSpec(["angle", "rate", "target"], ["torque"], angles=["angle"], exogenous=["target"])


def swing(X):
    angle, rate, torque = X.unbind(-1)
    return torch.stack([angle + 0.1 * rate, rate + 0.1 * (torque - angle.sin())], dim=-1)


def test_physics_has_its_own_slopes_and_no_variance():
    states, actions = normal(5, 3), normal(5, 1, seed=1)
    near = linearised(PhysicsDynamics(SPEC, swing), states, actions)
    expected = torch.eye(3).double().repeat(5, 1, 1)
    expected[:, 0, 1], expected[:, 1, 0] = 0.1, -0.1 * states[:, 0].cos()
    assert torch.allclose(near.slope, expected)
    assert torch.equal(near.mean[:, 2], states[:, 2])
    covariance = torch.eye(3).double().expand(5, 3, 3)
    assert torch.allclose(near.carry(covariance), expected @ expected.mT)


def test_learnt_slopes_are_those_of_differences():
    states, actions = normal(30, 3), normal(30, 1, seed=1)
    moved = swing(torch.cat([states[:, :2], actions], -1)) + 0.01 * normal(30, 2, seed=2)
    dynamics = LearnedDynamics(SPEC, model=ZeroMeanGP, fit_options={"method": "map"})
    dynamics.update(states, actions, torch.cat([moved, states[:, 2:]], -1))
    near, move = linearised(dynamics, states, actions), dynamics.mean_function()
    for i in range(3):
        step = 1e-5 * torch.eye(3, dtype=torch.float64)[i]
        ends = [move((states + sign * step)[None], actions[None])[0] for sign in (1, -1)]
        assert torch.allclose(near.slope[..., i], (ends[0] - ends[1]) / 2e-5, atol=1e-6)
    assert torch.equal(near.variance, dynamics.predict(states, actions).variance)
    assert (near.carry(torch.zeros(30, 3, 3).double()).diagonal(dim1=1, dim2=2) >= 0).all()
