"""Posteriors are right whatever the size of the targets, of which they are multiples."""

import pytest
import torch
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.posteriors.fully_bayesian import GaussianMixturePosterior

from gpadjust import CKA, PhysicsMeanGP, StackedGP, fit
from tests.systems import crude, holding, line, refused, wave

SIZES = [1e-12, 1e-6, 1e-3, 1e6, 1e12]
LEVELS = torch.tensor([0.025, 0.5, 0.975], dtype=torch.float64)
WEIGHTS = torch.tensor([1.0, -3.0], dtype=torch.float64)


@pytest.fixture
def sized(data):
    """`sized(of, size, m, noisy, num_samples)` is a model of targets of that size."""

    def sized(of, size, num_outputs, noisy, num_samples):
        X, Y = data(n=12, num_outputs=num_outputs)
        model = of(X, size * Y, physics=lambda X: size * crude(X)[..., :num_outputs])
        raw = model.likelihood.noise_covar.raw_noise
        with torch.no_grad():
            raw.fill_(-4.0 if noisy else -20.0)
        if num_samples:
            holding(model, *torch.linspace(-0.3, 0.2, num_samples).tolist())
        return model.eval()

    return sized


def posteriors(model, Z):
    """By name: a posterior, and whether it has the units of the targets."""
    yield "f", model.posterior(Z), True
    yield "observations", model.posterior(Z, observation_noise=True), True
    if isinstance(model, CKA):
        yield "rho", model.rho(Z), False
    if not isinstance(model, StackedGP):
        yield "delta", model.delta(Z), True
    if model.num_outputs > 1:
        yield "output", model.posterior(Z, [1]), True
        weighted = ScalarizedPosteriorTransform(WEIGHTS)
        yield "weighted", model.posterior(Z, posterior_transform=weighted), True


def moments(model, Z, size):
    """What posteriors say, in multiples of the size."""
    found = {"predict": model.predict(Z).variance / size**2}
    low, high = model.interval(Z)
    found["interval"] = (high - low) / size
    for name, posterior, has_units in posteriors(model, Z):
        unit = size if has_units else 1.0
        found[f"{name}, variance"] = posterior.variance / unit**2
        found[f"{name}, quantiles"] = posterior.quantile(LEVELS).diff(dim=0) / unit
        found[f"{name}, density"] = posterior.density(posterior.mean.flatten()[0]) * unit
        if isinstance(posterior, GaussianMixturePosterior):
            found[f"{name}, mixture"] = posterior.mixture_variance / unit**2
    return found


def alike(found, expected):
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        size = values.abs().max().item()
        torch.testing.assert_close(found[name], values, rtol=1e-3, atol=1e-9 * size, msg=name)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("of", [CKA, PhysicsMeanGP])
@pytest.mark.parametrize("num_samples", [0, 3])
@pytest.mark.parametrize("noisy", [True, False])
def test_multiples_of_the_size(sized, uniform, of, size, num_outputs, noisy, num_samples):
    Z = uniform(7, 2, high=2.0, seed=1)
    with torch.no_grad():
        one, other = (sized(of, s, num_outputs, noisy, num_samples) for s in (1.0, size))
        alike(moments(other, Z, size), moments(one, Z, 1.0))


@pytest.mark.parametrize("size", SIZES[::2])
def test_mixtures_of_structures(sized, uniform, size, num_outputs):
    Z = uniform(7, 2, high=2.0, seed=1)
    weights = torch.tensor([[0.75], [0.25]], dtype=torch.float64).expand(2, num_outputs)

    def stacked(size):
        kinds = {"CKA": (CKA, 3), "physics mean": (PhysicsMeanGP, 0)}
        models = {n: sized(of, size, num_outputs, True, s) for n, (of, s) in kinds.items()}
        return StackedGP(models, weights, num_components=8)

    with torch.no_grad():
        alike(moments(stacked(size), Z, size), moments(stacked(1.0), Z, 1.0))


@pytest.mark.parametrize("size", SIZES[::2])
def test_quantiles_are_those_of_the_interval(sized, uniform, size):
    model, Z = sized(CKA, size, 1, True, 3), uniform(7, 2, high=2.0, seed=1)
    with torch.no_grad():
        low, middle, high = model.posterior(Z).quantile(LEVELS)
        ends = model.interval(Z, 0.95)
        draws = model.posterior(Z).rsample(torch.Size([40_000])).flatten(0, 1)
    torch.testing.assert_close((low, high), ends, rtol=0, atol=1e-9 * size)
    sd = draws.std(0)
    for level, found in zip(LEVELS, (low, middle, high), strict=True):
        assert ((draws.quantile(float(level), dim=0) - found).abs() < 0.05 * sd).all()


def test_one_quantile_has_no_dimension_of_its_own(sized, uniform):
    posterior = sized(CKA, 1.0, 2, True, 3).posterior(uniform(5, 4, 2))
    single = posterior.quantile(LEVELS[1])
    assert single.shape == (5, 4, 2)
    assert torch.equal(posterior.quantile(LEVELS)[1], single)


@pytest.mark.parametrize("level", [0.0, 1.0, -0.5, float("nan")])
def test_levels_out_of_range(sized, uniform, level):
    posterior = sized(CKA, 1.0, 1, True, 3).posterior(uniform(4, 2))
    refused(ValueError, "between 0 and 1", posterior.quantile, torch.tensor(level))


@pytest.mark.parametrize("method", ["bayes", "map"])
@pytest.mark.parametrize("size", [1e-6, 1.0])
def test_eight_points_without_noise(uniform, method, size):
    """Variances of 1e-11 and less, without a warning (each is an error here)."""
    X = line(8)
    model = CKA(X, size * (2 * wave(X) + X), physics=lambda X: size * wave(X))
    fit(model, method)
    Z = uniform(5, 1)
    with torch.no_grad():
        posterior, (_, variance) = model.posterior(Z), model.predict(Z)
        found = posterior.mixture_variance if method == "bayes" else posterior.variance
        draws = posterior.rsample(torch.Size([4000]))
    torch.testing.assert_close(found, variance, rtol=1e-3, atol=1e-13 * size**2)
    assert ((draws.std(0) / posterior.variance.sqrt() - 1).abs() < 0.1).all()
