"""NUTS as a reference: a known posterior, shapes, and what it refuses."""

import sys

import pytest
import torch

from gpadjust import CKA, CalibratedPhysics, FunctionPhysics, Unknown, fit
from gpadjust.core import SamplingWarning
from gpadjust.many import VariationalCKA
from tests.systems import line, refused, wave

pytestmark = pytest.mark.filterwarnings("ignore:Chains do not agree")


def linear(sd=0.1):
    X = line(12)
    noise = torch.randn(X.shape, generator=torch.Generator().manual_seed(0), dtype=X.dtype)
    f_p = FunctionPhysics(lambda X, p: p.k * X[:, 0], unknowns={"k": Unknown(1.0, sd=1.0)})
    return CalibratedPhysics(X, 2 * X + sd * noise, torch.full_like(X, sd**2), physics=f_p)


@pytest.mark.slow
def test_draws_of_a_line_are_those_of_its_posterior():
    model = linear()
    result = fit(model, "nuts", num_draws=400)
    X, Y = model.data.X[:, 0], model.data.Y[:, 0]
    precision = 1 + X.square().sum() / 0.01
    mean = (1 + (X * Y).sum() / 0.01) / precision
    found = model.physics_parameters
    assert len(found.draws) == 400
    assert result.converged
    assert result.rhat < 1.05
    assert float(found.mean) == pytest.approx(float(mean), abs=0.2 * float(precision) ** -0.5)
    assert float(found.sd) == pytest.approx(float(precision) ** -0.5, rel=0.15)
    assert "R-hat" in str(result)
    assert model.predict(line(3)).mean.shape == (3, 1)


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


def test_refused(monkeypatch):
    X = line(9)
    refused(ValueError, "nested=False", fit, CKA(X, wave(X), physics=wave), "nuts")
    few = VariationalCKA(X, wave(X), physics=wave, num_inducing=4)
    refused(ValueError, "no density", fit, few, "nuts")
    monkeypatch.setitem(sys.modules, "pyro.infer", None)
    refused(ImportError, r"gpadjust\[pyro\]", fit, linear(), "nuts")
