"""Joint samples, quantiles and densities of posteriors, which are mixtures."""

import pytest
import torch
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.sampling import IIDNormalSampler, SobolQMCNormalSampler

from gpadjust.core import CKA, RRA, MixturePosterior
from tests.systems import crude

DRAWS = 20_000


def agree(posterior, samples):
    """Standard deviations to 3 %, correlations to 0.05."""
    covariance = posterior.distribution.covariance_matrix
    sd = covariance.diagonal().sqrt()
    torch.testing.assert_close(sd, posterior.variance.mT.flatten().sqrt())
    standard = (samples.mT.flatten(1) - posterior.mean.mT.flatten()) / sd
    assert (standard.mean(0).abs() < 0.04).all()
    assert ((standard.std(0) - 1).abs() < 0.03).all()
    correlation = covariance / sd.outer(sd)
    assert ((standard.mT @ standard / len(samples) - correlation).abs() < 0.05).all()


@pytest.fixture
def model_of(data, drawn):
    def model_of(kind, size=1.0, noise_free=False, number=3):
        X, Y = data(n=12, num_outputs=2)
        options = {"train_Yvar": 0.0} if noise_free else {}
        cls = {"CKA": CKA, "RRA": RRA}[kind]
        return drawn(cls(X, size * Y, physics=lambda X: size * crude(X), **options), number), X

    return model_of


@pytest.mark.parametrize("noise_free", [False, True], ids=["noisy", "exact"])
@pytest.mark.parametrize(("kind", "size"), [("CKA", 1e-9), ("RRA", 1e6)])
def test_samples_have_the_moments(kind, noise_free, size, model_of, uniform):
    model, X = model_of(kind, size, noise_free=noise_free)
    Z = torch.cat([X[:4], uniform(8, 2, high=2.0, seed=1)])
    weigh = ScalarizedPosteriorTransform(torch.tensor([1.0, -3.0], dtype=torch.float64), 2 * size)
    whole = lambda Z: model.posterior(Z, posterior_transform=weigh)  # noqa: E731
    for ask in (model.posterior, whole, model.rho, model.delta):
        agree(ask(Z), ask(Z).rsample(torch.Size([DRAWS])))
        leaf = Z.clone().requires_grad_()
        (slope,) = torch.autograd.grad(ask(leaf).rsample(torch.Size([30])).sum(), leaf)
        assert slope.isfinite().all()
        assert (slope != 0).any()


@pytest.mark.parametrize("sampler", [IIDNormalSampler, SobolQMCNormalSampler])
def test_samplers_of_botorch_and_batches(sampler, model_of, uniform):
    model, _ = model_of("CKA")
    Z = uniform(3, 4, 2, high=2.0, seed=1)
    samples = sampler(torch.Size([DRAWS]), seed=0)(model.posterior(Z))
    assert samples.shape == (DRAWS, 3, 4, 2)
    for i in range(3):
        agree(model.posterior(Z[i]), samples[:, i])


def test_draws_are_of_one_component_each(close):
    means = torch.tensor([-1e3, 0.0, 1e3], dtype=torch.float64).reshape(3, 1, 1).expand(3, 2, 5)
    posterior = MixturePosterior(means, torch.eye(5, dtype=torch.float64).expand(3, 2, 5, 5))
    near = (posterior.rsample(torch.Size([600])) / 1e3).round().flatten(1)
    assert (near == near[:, :1]).all()
    assert all(150 < (near[:, 0] == k).sum() < 250 for k in (-1, 0, 1))
    between = means[:, 0, 0].var(correction=0)
    expected = between * torch.ones(10, 10).double() + torch.eye(10)
    close(posterior.distribution.covariance_matrix, expected)
    close(posterior.mean, torch.zeros(5, 2, dtype=torch.float64))


def test_weighted_sums_of_outputs(model_of, uniform, close):
    model, _ = model_of("CKA")
    posterior, w = model.posterior(uniform(5, 2)), torch.tensor([1.0, -3.0], dtype=torch.float64)
    K = posterior.distribution.covariance_matrix.reshape(2, 5, 2, 5)
    total = posterior.scalarized(w, 7.0)
    close(total.mean, (posterior.mean @ w).unsqueeze(-1) + 7)
    close(total.distribution.covariance_matrix, torch.einsum("i,iajb,j->ab", w, K, w))


@pytest.mark.parametrize("number", [1, 6])
def test_quantiles_densities_and_intervals(number, model_of, uniform):
    model, _ = model_of("CKA", 1e3, number=number)
    Z = uniform(5, 2, high=2.0, seed=1)
    levels = torch.tensor([0.025, 0.3, 0.3001, 0.975], dtype=torch.float64)
    with torch.no_grad():
        posterior = model.posterior(Z)
        first, low, high, last = posterior.quantile(levels)
        samples = posterior.rsample(torch.Size([40_000]))
    share = posterior.density((low + high) / 2) * (high - low)
    torch.testing.assert_close(share, torch.full_like(low, 1e-4), rtol=1e-3, atol=0)
    at_zero = posterior.density(low[0, 0])  # one value for all points, as BoTorch has it
    torch.testing.assert_close(at_zero[0, 0], posterior.density(low)[0, 0])
    torch.testing.assert_close(model.interval(Z), (first, last), rtol=1e-10, atol=0)
    sd = posterior.variance.sqrt()
    for level, found in zip(levels, (first, low, high, last), strict=True):
        assert ((samples.quantile(float(level), dim=0) - found).abs() < 0.05 * sd).all()


def test_the_density_of_rho_where_some_draws_know_it(model_of, uniform, close):
    """Of three draws the last one is of the nested model that ignores the physics, rho = 0."""
    model, _ = model_of("CKA")
    Z, value = uniform(5, 2), torch.full((5, 2), 1.2, dtype=torch.float64)
    other = model.subset_draws(torch.tensor([0, 1])).rho(Z)
    close(model.rho(Z).density(value), other.density(value) * 2 / 3)


def test_outputs_by_number(model_of, uniform, alike, close):
    model, X = model_of("CKA")
    Z, whole = uniform(5, 2), model.posterior(uniform(5, 2))
    for outputs in ([1, 0], [-1]):
        subset = model.subset_output(outputs)
        alike(model.posterior(Z, outputs), whole, outputs=outputs)
        first = subset.subset_output([0])  # of a part
        close(first.predict(Z).mean, whole.mean[:, outputs[:1]])
        u = subset.u.detach()
        close(subset.log_likelihood(u)[0], model.log_likelihood(model.u)[0][:, outputs])
    known = CKA(X, model.data.Y, torch.tensor([0.01, 0.4]).double(), physics=crude)
    close(known.subset_output([1]).predict(Z).mean, known.predict(Z).mean[:, [1]])


def test_the_posterior_of_gpytorch(model_of, uniform, close):
    """`model(X)`, of several draws and where points are nearly one."""
    model, X = model_of("CKA", number=3)
    Z = torch.cat([X, uniform(8, 2, high=2.0), X[:2] + 1e-9])
    law = model(Z)
    close(law.mean.mean(0).mT, model.posterior(Z).mean)
    assert model.likelihood(law).mean.shape == (3, 2, 22)
