"""Errors of a state's entries that are correlated: drawn jointly in free runs, if data show it."""

import math
from functools import cache

import pytest
import torch

from gpadjust.dynamics import LearnedDynamics, StateSpec
from gpadjust.dynamics.learned_dynamics import error_correlation

SPEC = StateSpec(["angle", "rate"], ["torque"])
SD = torch.tensor([0.02, 0.05], dtype=torch.float64)


def pendulum(X):
    angle, rate, torque = X.unbind(-1)
    return torch.stack([angle + 0.1 * rate, rate - 0.1 * angle + 0.1 * torque], dim=-1)


@cache
def learnt(correlation, n):
    """Dynamics of a pendulum, whose angle and rate are shaken together."""
    generator = torch.Generator().manual_seed(0)
    X = 2 * torch.rand(n, 3, generator=generator, dtype=torch.float64) - 1
    white = torch.randn(n, 2, generator=generator, dtype=torch.float64)
    white[:, 1] = correlation * white[:, 0] + math.sqrt(1 - correlation**2) * white[:, 1]
    following = pendulum(X) + 0.02 * X[:, :1].sin() + SD * white
    dynamics = LearnedDynamics(SPEC, pendulum, fit_options={"num_draws": 8})
    dynamics.update(X[:, :2], X[:, 2:], following)
    return dynamics


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["measured", "process", "sampled"])
def test_spread_of_a_derived_quantity(kind, monkeypatch):
    dynamics, correlation = learnt(0.8, 120), 0.8
    weights = torch.tensor([2.5, -1.0], dtype=torch.float64)  # a difference, in equal units
    expected = math.sqrt(2 * (1 - correlation)) * 0.05
    own = {"noise": False, "process_noise": "learnt"} if kind == "process" else {}

    def spread():
        start, actions = torch.zeros(2000, 2).double(), torch.zeros(2000, 1).double()
        if kind == "sampled":
            after = dynamics.sample(start, actions)
        else:
            run = dynamics.free_run(start[:50], actions[:50].unsqueeze(1), **own)
            after = run.particles[:, :, 0]
        return float((after @ weights).std())

    assert spread() == pytest.approx(expected, rel=0.1)
    monkeypatch.setattr(dynamics, "noise_root", lambda: None)
    assert spread() > 1.8 * expected


@pytest.mark.slow
def test_no_correlation_is_used_where_none_is_clear():
    dynamics = learnt(0.0, 60)
    assert error_correlation(dynamics.model) is None
    assert dynamics.noise_root() is None


def test_correlation_is_shrunk_and_a_root_exists():
    found = error_correlation(learnt(0.8, 120).model)
    assert 0.7 < found[0, 1] < 0.87
    torch.linalg.cholesky(found)
