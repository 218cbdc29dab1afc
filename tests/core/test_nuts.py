"""NUTS as a reference: a known posterior, shapes, and what it refuses."""

import sys

import pytest
import torch

from gpadjust import CKA, CalibratedPhysics, FunctionPhysics, Unknown, fit
from gpadjust.core import SamplingWarning
from gpadjust.core.nuts import nuts
from tests.systems import line, normal, refused, wave

pytestmark = pytest.mark.filterwarnings("ignore:Chains do not agree")


def linear(sd=0.1):
    X = line(12)
    noise = normal(*X.shape)
    f_p = FunctionPhysics(lambda X, p: p.k * X[:, 0], unknowns={"k": Unknown(1.0, sd=1.0)})
    return CalibratedPhysics(X, 2 * X + sd * noise, torch.full_like(X, sd**2), physics=f_p)


@pytest.mark.slow
def test_draws_of_a_line_are_those_of_its_posterior():
    model = linear()
    X, Y = model.data.X[:, 0], model.data.Y[:, 0]
    result = fit(model, "nuts", num_draws=400)
    # The prior of the slope is N(1, 1).
    precision = 1 + float(X.square().sum()) / 0.01
    mean = (1 + float((X * Y).sum()) / 0.01) / precision
    found = model.physics_parameters
    assert len(found.draws) == 400
    assert result.converged
    assert result.rhat < 1.05
    assert float(found.mean) == pytest.approx(mean, abs=0.2 * precision**-0.5)
    assert float(found.sd) == pytest.approx(precision**-0.5, rel=0.15)
    assert "R-hat" in str(result)


def test_chains_jump_between_modes_as_often_as_these_are_likely():
    X = line(12)
    f_p = FunctionPhysics(lambda X, p: p.k**2 * X[:, 0], unknowns={"k": Unknown(0.5, sd=1.0)})
    model = CalibratedPhysics(X, 2 * X, torch.full_like(X, 0.25), physics=f_p)
    root = 2**0.5
    k = torch.where(torch.arange(64) % 2 == 0, root, -root).to(X) + 0.1 * normal(64)
    row = model.table.shared[0]
    draws = model.u.detach().expand(64, -1, -1).clone()
    draws[..., -1] = row.coordinate(k).unsqueeze(-1)  # half of them in each mode
    u, rhat = nuts(model, draws, 160, 0)
    model.set_draws(u)
    positive = (model.physics_parameters.draws > 0).double().mean()
    # p(k) ~ N(y | k^2 x, 0.25) N(k | 0.5, 1), by sums on a grid.
    grid = torch.linspace(-4, 4, 4001, dtype=X.dtype)
    misfit = (2 * X - grid.square() * X).square().sum(0) / 0.25
    density = (-0.5 * misfit - 0.5 * (grid - 0.5).square()).exp()
    expected = float(density[grid > 0].sum() / density.sum())
    assert 0.7 < expected < 0.9
    assert float(positive) == pytest.approx(expected, abs=0.1)
    assert rhat < 1.05


def test_seeds_and_the_generator_of_the_user():
    model = linear()
    torch.manual_seed(5)
    fit(model, "nuts", num_draws=16, seed=1)
    u, after = model.draws.clone(), torch.rand(())
    torch.manual_seed(5)
    assert torch.rand(()) == after
    fit(model, "nuts", num_draws=16, seed=1)
    assert model.draws.equal(u)


def test_chains_that_do_not_agree_warn():
    X = line(9)
    model = CKA(X, 2 * wave(X) + X, physics=wave, nested=False)
    with pytest.warns(SamplingWarning, match="Chains do not agree"):
        result = fit(model, "nuts", num_draws=16)
    assert not result.converged


def test_pyro_is_needed(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyro.infer", None)
    refused(ImportError, r"gpadjust\[pyro\]", fit, linear(), "nuts")
