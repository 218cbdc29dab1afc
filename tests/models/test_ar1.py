"""AR1 as joint co-kriging of two levels."""

import numpy as np
import pytest
import torch
from botorch.models.transforms import Normalize

from gpadjust import AR1, fit
from gpadjust.inference.targets import LogPosterior
from tests.systems import crude, line


@pytest.fixture
def levels(uniform):
    X, low_X = uniform(7, 2, high=2.0, seed=1), uniform(11, 2, high=2.0, seed=2)
    low_Y = crude(low_X)[:, :1]
    Y = 1.7 * crude(X)[:, :1] + X.sum(-1, keepdim=True).sin()
    return X, Y, low_X, low_Y


@pytest.fixture
def ar1(levels, shuffle):
    X, Y, low_X, low_Y = levels
    return shuffle(AR1(X, Y, low_X=low_X, low_Y=low_Y))


@pytest.fixture
def users_units(ar1, rbf, kernel_of):
    """Kernels, rho and noises of the model in the user's units."""
    scale, shift = ar1.outcome_transform.stdvs.squeeze(), ar1.outcome_transform.means.squeeze()
    low, delta = kernel_of(ar1, "low"), kernel_of(ar1, "delta")
    noise = ar1.likelihood.noise.detach() * scale**2

    def kernel(part):
        return rbf(part.base_kernel.lengthscale.detach(), part.outputscale.detach() * scale**2)

    return kernel(low), kernel(delta), ar1.rho_constant.item(), noise, shift


def test_joint_co_kriging(ar1, users_units, levels, close, uniform):
    X, Y, low_X, low_Y = levels
    k_1, k_delta, rho, noise, shift = users_units
    Z = uniform(5, 2, high=2.0, seed=3)
    high = rho**2 * k_1(X, X) + k_delta(X, X) + noise[1] * torch.eye(7, dtype=torch.float64)
    low = k_1(low_X, low_X) + noise[0] * torch.eye(11, dtype=torch.float64)
    between = rho * k_1(low_X, X)
    K = torch.cat([torch.cat([low, between], 1), torch.cat([between.mT, high], 1)])
    cross = torch.cat([rho * k_1(Z, low_X), rho**2 * k_1(Z, X) + k_delta(Z, X)], dim=1)
    y = torch.cat([low_Y, Y])[:, 0] - shift
    prior = rho**2 * k_1(Z, Z) + k_delta(Z, Z)
    posterior = ar1.posterior(Z)
    close(posterior.mean.squeeze(-1).detach(), shift + cross @ torch.linalg.solve(K, y))
    covariance = prior - cross @ torch.linalg.solve(K, cross.mT)
    close(posterior.distribution.covariance_matrix.detach(), covariance)
    noisy = ar1.posterior(Z, observation_noise=True).variance.squeeze(-1)
    close(noisy.detach(), covariance.diagonal() + noise[1])


def test_recursive_co_kriging_on_nested_designs(rbf, close, uniform, kernel_of):
    """Le Gratiet and Garnier's recursion equals the joint model when there is no noise."""
    low_X = uniform(12, 2, high=2.0, seed=2)
    X = low_X[:6]
    low_Y = crude(low_X)[:, :1]
    Y = 1.7 * low_Y[:6] + X.sum(-1, keepdim=True).sin()
    model = AR1(X, Y, low_X=low_X, low_Y=low_Y, outcome_transform=None)
    with torch.no_grad():
        for name, length in (("low", 0.5), ("delta", 0.9)):
            kernel_of(model, name).base_kernel.raw_lengthscale.fill_(np.log(length))
            kernel_of(model, name).raw_outputscale.fill_(0.0)
        model.rho_constant.fill_(1.4)
        model.likelihood.noise_covar.raw_noise.fill_(np.log(1e-12))
    k_1, k_delta = rbf(0.5, 1.0), rbf(0.9, 1.0)
    Z = uniform(5, 2, high=2.0, seed=3)
    first = k_1(Z, low_X) @ torch.linalg.solve(k_1(low_X, low_X), low_Y)
    bias = k_delta(Z, X) @ torch.linalg.solve(k_delta(X, X), Y - 1.4 * low_Y[:6])
    variance = 1.4**2 * (
        k_1(Z, Z) - k_1(Z, low_X) @ torch.linalg.solve(k_1(low_X, low_X), k_1(low_X, Z))
    ) + (k_delta(Z, Z) - k_delta(Z, X) @ torch.linalg.solve(k_delta(X, X), k_delta(X, Z)))
    posterior = model.eval().posterior(Z)
    close(posterior.mean.detach(), 1.4 * first + bias, 1e-6)
    close(posterior.variance.squeeze(-1).detach(), variance.diagonal(), 1e-6)


def test_low_values_are_those_of_the_physics(levels, uniform):
    X, Y, low_X, low_Y = levels
    given = AR1(X, Y, low_X=low_X, low_Y=low_Y)
    computed = AR1(X, Y, low_X=low_X, physics=lambda X: crude(X)[:, :1])
    Z = uniform(5, 2)
    torch.testing.assert_close(given.posterior(Z).mean, computed.posterior(Z).mean)


def test_each_level_has_a_noise_of_its_own(ar1, levels):
    X, Y, low_X, low_Y = levels
    initial = AR1(X, Y, low_X=low_X, low_Y=low_Y)
    low, high = initial.train_targets.split([11, 7])
    expected = 1e-2 * torch.stack([low.var(correction=0), high.var(correction=0)])
    torch.testing.assert_close(initial.likelihood.noise.detach(), expected)
    assert ar1.likelihood.noise.shape == (2,)
    low, high = ar1.likelihood.noise.tolist()
    inputs = ar1.train_inputs[0]
    prior = ar1.forward(inputs)
    noise = ar1.likelihood(prior, inputs).variance - prior.variance
    expected = torch.tensor([low] * 11 + [high] * 7, dtype=torch.float64)
    torch.testing.assert_close(noise.detach(), expected)


def test_the_samples_lie_within_the_bounds_and_the_seed_makes_them(data, build):
    X, Y = data()
    seen = []

    def physics(X):
        seen.append(X)
        return crude(X)[:, :1]

    bounds = torch.tensor([[-3.0, 1.0], [-2.0, 5.0]], dtype=torch.float64)
    AR1(X, Y, physics=physics, bounds=bounds, num_low=33)
    rows = torch.cat(seen)
    assert len(rows) == 33
    assert (rows >= bounds[0]).all()
    assert (rows <= bounds[1]).all()
    assert (rows.amax(0) - rows.amin(0) > 0.8 * (bounds[1] - bounds[0])).all()
    X, Y = data()
    first, same, other = (build("AR1", X, Y, seed=s).train_inputs[0] for s in (1, 1, 2))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("transform", [{}, {"outcome_transform": None}])
@pytest.mark.parametrize("small", [1.0, 0.1])
def test_known_noise_of_a_prediction_is_the_high_levels(
    data, build, uniform, num_outputs, transform, small
):
    X, Y = data(num_outputs=num_outputs)
    Yvar = torch.linspace(0.01, 0.03, len(Y), dtype=torch.float64).unsqueeze(-1).expand_as(Y)
    physics = {"physics": lambda X: small * crude(X)[..., :num_outputs]}
    model = build("AR1", X, small * Y, Yvar, **physics, **transform)
    Z = uniform(4, 2, high=2.0, seed=3)
    added = model.posterior(Z, observation_noise=True).variance - model.posterior(Z).variance
    torch.testing.assert_close(added, Yvar.mean().expand_as(added))


@pytest.mark.parametrize("Yvar", [None, 0.01])
def test_low_values_that_are_missing(uniform, close, Yvar):
    X, low_X, Z = (uniform(n, 2, high=2.0, seed=n) for n in (7, 11, 5))
    Y, low_Y = crude(X)[:, :1].cos(), crude(low_X)[:, :1]
    fewer = AR1(X, Y, Yvar, low_X=low_X[1:], low_Y=low_Y[1:])
    both = low_Y.expand(-1, 2).clone()
    both[0, 1] = torch.nan
    two = AR1(X, Y.expand(-1, 2), Yvar, low_X=low_X, low_Y=both)
    close(two.outcome_transform.stdvs[..., 1], fewer.outcome_transform.stdvs[..., 0])
    for model in (two, fewer):
        fit(model, "map")
    torch.testing.assert_close(two.predict(Z).mean[:, 1:], fewer.predict(Z).mean, rtol=1e-4, atol=0)


def test_what_was_learnt_stays_and_priors_are_each_outputs_own(uniform, levels):
    X, low_X, Z = uniform(7, 1), uniform(11, 1, seed=1), 3 + uniform(2, 1, seed=2)
    low_Y, Y = low_X.sin(), X.sin() + X
    model = AR1(X, Y, low_X=low_X, low_Y=low_Y, input_transform=Normalize(1))
    model = model.condition_on_observations(Z, Z.sin() + Z)
    before = model.predict(Z)
    model.train()
    model.eval()
    torch.testing.assert_close(model.predict(Z).mean, before.mean)
    X, Y, low_X, low_Y = levels
    both = AR1(X, torch.cat([Y, 9 * Y], -1), low_X=low_X, low_Y=low_Y.expand(-1, 2))
    own = AR1(X, 9 * Y, low_X=low_X, low_Y=low_Y)
    part = both.subset_output([1])
    torch.testing.assert_close(part.terms[0].basis.ratio, own.terms[0].basis.ratio)
    X = torch.tensor([[0.0], [1.0], [2.0]], dtype=torch.float64)
    model = AR1(X, X, low_X=X, low_Y=torch.full_like(X, 3.0))
    assert model.terms[0].basis.prior_of_learnt[1].item() == 1.0


@pytest.mark.parametrize("which", [0, 1])
def test_the_size_of_a_trend_of_either_level_has_no_vote(which):
    low_X = line(20)
    X = line(9)
    low, high = 1 - 2 * low_X, 3 + 2 * X
    if which == 1:  # it is delta that has a trend
        low, high = (5 * low_X).sin(), high + 2 * (5 * X).sin()
    model = AR1(X, high, low_X=low_X, low_Y=low)
    kernel = model.terms[which].kernel
    with torch.no_grad():
        kernel.base_kernel.raw_lengthscale.fill_(np.log(100.0))
        model.rho_constant.fill_(2.0)
        model.likelihood.noise_covar.raw_noise.fill_(np.log(1e-2))
    values = []
    for variance in (1e5, 1e7):
        kernel.outputscale = variance
        objective = LogPosterior(model)
        vector = objective.parameters.current()
        values.append(objective(vector).item() + vector[0, 0, :].sum().item())
    assert (values[1] - values[0]) / np.log(100) == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_a_discrepancy_that_is_nearly_polynomial(unit):
    """Of Forrester et al. (2007): the function, and a quarter of it with a parabola."""

    def high(X):
        return (6 * X - 2).square() * (12 * X - 4).sin()

    X = line(6, 0.05, 0.95)
    low_X = torch.cat([X, line(15)])
    low_Y = unit * (0.25 * high(low_X) + 20 * low_X.square() - 10)
    model = AR1(X, high(X), low_X=low_X, low_Y=low_Y)
    fit(model)
    Z = line(50)
    assert (model.predict(Z).mean - high(Z)).square().mean().sqrt() < 0.1 * high(Z).std()
    lower, upper = model.interval(Z)
    assert ((lower <= high(Z)) & (high(Z) <= upper)).double().mean() > 0.9
