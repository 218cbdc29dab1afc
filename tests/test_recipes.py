"""What docs/architecture.md shows for something new: each recipe runs as it stands."""

import re
from pathlib import Path

import pytest
import torch
from botorch.models import ModelListGP
from gpytorch.constraints import Interval
from gpytorch.kernels import RBFKernel, ScaleKernel

from gpadjust import CKA, fit
from gpadjust.gp.kernels import PROFILES
from gpadjust.inference import fitting
from gpadjust.inference.distributions import StationaryTerms
from gpadjust.inference.targets import LogLikelihood
from tests.systems import wave

PAGE = Path(__file__).parents[1] / "docs" / "architecture.md"


def recipe(heading):
    """The names that the code below a heading makes."""
    text = PAGE.read_text().split(f"\n**{heading}**", 1)[1]
    names = {"__name__": "recipe"}
    exec(re.search(r"```python\n(.*?)```", text, flags=re.DOTALL)[1], names)
    return names


@pytest.fixture
def data(uniform):
    X = uniform(14, 1)
    return X, 2 * wave(X) + X + 0.05 * uniform(14, 1, seed=1)


@pytest.mark.slow
def test_a_structure(data, uniform):
    X, Y = data
    model = recipe("A structure")["SeasonalCKA"](X, Y, physics=wave)
    fit(model, num_starts=2, num_screened=16, num_draws=32)
    assert model.term_names == ("rho", "delta", "season")
    parts = model.rho(X).mean * wave(X) + model.delta(X).mean + model.term("season", X).mean
    # Of a mixture, the mean of a product of rho and f_p is that of rho times f_p.
    torch.testing.assert_close(parts, model.predict(X).mean, atol=1e-6, rtol=1e-6)


def test_a_kernel_is_fast_and_right(data, monkeypatch):
    monkeypatch.setattr("gpadjust.gp.kernels.PROFILES", PROFILES)
    kernel_class = recipe("A kernel")["RationalQuadratic"]
    X, Y = data
    model = CKA(X, Y, physics=wave, delta_covar_module=ScaleKernel(kernel_class()).double())
    model.posterior(X)
    delta = model.terms[1]
    expected = delta.kernel(X, X[:3]).to_dense()
    torch.testing.assert_close(delta.covariance(X, X[:3]), expected)
    target = LogLikelihood(model)
    assert isinstance(target.distribution, StationaryTerms)
    vectors = target.parameters.current()
    _, gradient = target.value_and_gradient(vectors)
    for i in range(vectors.shape[-1]):
        step = torch.zeros_like(vectors)
        step[..., i] = 1e-5
        slope = (target(vectors + step) - target(vectors - step)) / 2e-5
        torch.testing.assert_close(gradient[..., i], slope, atol=1e-5, rtol=1e-4)
    del PROFILES[kernel_class]


def test_a_noise(data, uniform):
    X, _ = data
    X = torch.cat([X, uniform(40, 1, seed=2)])
    torch.manual_seed(0)
    Y = wave(X) * (1 + 0.2 * torch.randn_like(X))
    noise = recipe("A noise")["PartlyRelativeNoise"]()
    model = CKA(X, Y, physics=wave, likelihood=noise)
    fit(model, "map", num_starts=4)
    assert isinstance(LogLikelihood(model).distribution, StationaryTerms)
    model.eval()
    large, small = (torch.tensor([[x]], dtype=torch.float64) for x in (0.26, 0.523))
    sd = [
        float(model.predict(x, observation_noise=True).variance - model.predict(x).variance) ** 0.5
        for x in (large, small)
    ]
    assert 0.1 < sd[0] < 0.4
    assert sd[1] < 0.1 * sd[0]


def test_an_inference_method(data, monkeypatch):
    monkeypatch.setattr(fitting, "METHODS", dict(fitting.METHODS))
    method = recipe("An inference method")["METHODS"]["laplace"]
    fitting.METHODS["laplace"] = method
    X, Y = data
    model = CKA(X, Y, physics=wave)
    before = torch.random.get_rng_state()
    fit(model, "laplace", num_samples=8)
    assert model.num_samples == 8
    assert torch.equal(before, torch.random.get_rng_state())
    low, high = model.interval(X)
    assert ((low < Y + 0.1) & (high > Y - 0.1)).all()
    bounded = RBFKernel(lengthscale_constraint=Interval(0.1, 1.0)).double()
    models = [CKA(X, Y, physics=wave, delta_covar_module=bounded), CKA(X, Y, physics=wave)]
    results = fit(ModelListGP(*models), "laplace", num_samples=5)
    assert [each.num_samples for each in models] == [5, 5]
    lengthscale = results[0].draws["covar_module.terms.1.kernel.raw_lengthscale"]
    assert ((lengthscale >= 0.1) & (lengthscale <= 1.0)).all()
    assert models[0].predict(X).mean.isfinite().all()
