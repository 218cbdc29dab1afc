"""The likelihood of Gaussian targets against scipy, autograd and textbook least squares."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from gpadjust.gp.gaussian import Trend, cholesky, least_squares, negative_log_likelihood, nugget

n, q = 7, 2


@pytest.fixture
def problem(uniform):
    """A batch of three residuals and covariances, and a basis."""
    factor = uniform(3, n, n, low=-1, seed=1)
    covariance = factor @ factor.mT + 0.3 * torch.eye(n, dtype=torch.float64)
    return 3 * uniform(3, n, low=-1, seed=2), covariance, uniform(3, n, q, low=-1, seed=3)


def least():
    """Least scales of which one is below the best scale, and the others above it."""
    return torch.tensor([1e-9, 50.0, 60.0], dtype=torch.float64)


def formula(residual, covariance, basis=None, least=None):
    """The same likelihood from inverses and determinants, for autograd."""
    inverse, n = torch.linalg.inv(covariance), residual.shape[-1]
    if basis is not None:
        inside = torch.linalg.inv(basis.mT @ inverse @ basis)
        inverse = inverse - inverse @ basis @ inside @ basis.mT @ inverse
    square = (residual.unsqueeze(-2) @ inverse @ residual.unsqueeze(-1))[..., 0, 0]
    scale = torch.ones_like(square) if least is None else (square / n).maximum(least)
    fit = square / scale + n * scale.log()
    return 0.5 * (fit + torch.logdet(covariance) + n * math.log(2 * math.pi))


@pytest.mark.parametrize("with_basis", [False, True])
@pytest.mark.parametrize("with_scale", [False, True])
def test_it_is_the_least_of_scipys_densities_over_factor_and_coefficients(
    problem, with_basis, with_scale
):
    residual, covariance, basis = problem
    basis = basis if with_basis else basis[..., :0]
    found = negative_log_likelihood(
        residual,
        covariance.clone(),
        basis if with_basis else None,
        torch.zeros(3, dtype=torch.float64) if with_scale else None,
    )
    for i in range(3):

        def at(free, i=i):
            rest = residual[i] - basis[i] @ torch.from_numpy(free[1:])
            scaled = math.exp(free[0]) ** with_scale * covariance[i]
            return -multivariate_normal(cov=scaled.numpy()).logpdf(rest.numpy())

        best = minimize(at, np.zeros(1 + basis.shape[-1]), options={"gtol": 1e-7})
        assert found.value[i].item() == pytest.approx(best.fun, rel=1e-9)
        assert found.scale[i].log().item() == pytest.approx(best.x[0] * with_scale, abs=1e-4)


@pytest.mark.parametrize("with_least", [False, True])
@pytest.mark.parametrize("with_basis", [False, True])
def test_derivatives_are_autograds(problem, with_least, with_basis):
    residual, covariance, basis = problem
    basis = basis if with_basis else None
    bound = least().requires_grad_() if with_least else None
    mean = torch.zeros_like(residual).requires_grad_()
    leaf = covariance.clone().requires_grad_()
    value = formula(residual - mean, leaf, basis, bound)
    leaves = (mean, leaf, bound) if with_least else (mean, leaf)
    by_mean, by_covariance, *by_bound = torch.autograd.grad(value.sum(), leaves)
    with torch.no_grad():
        found = negative_log_likelihood(residual, covariance, basis, bound, derivatives=True)
    torch.testing.assert_close(found.value, value.detach(), rtol=1e-10, atol=0)
    torch.testing.assert_close(found.by_mean, by_mean, rtol=1e-6, atol=1e-9)
    symmetric = (by_covariance + by_covariance.mT) / 2
    torch.testing.assert_close(found.by_covariance, symmetric, rtol=1e-6, atol=1e-9)
    if with_least:
        expected = by_bound[0] * least()
        assert (expected != 0).tolist() == [False, True, True]
        torch.testing.assert_close(found.by_least_scale, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("with_missing", [False, True])
def test_a_trend_adds_the_determinant_of_its_coefficients_precision(problem, with_missing):
    residual, covariance, trend = problem
    kept = torch.arange(n) != 3 if with_missing else torch.ones(n, dtype=torch.bool)
    leaf = covariance.clone().requires_grad_()
    inside = leaf[:, kept][:, :, kept]
    white = torch.linalg.inv(inside) @ trend[:, kept]
    precision = trend[:, kept].mT @ white  # of the first column, and of all
    both = 0.7 * precision[:, 0, 0].log() + 0.3 * torch.logdet(precision)
    value = formula(residual[:, kept], inside) + 0.5 * both
    (by_covariance,) = torch.autograd.grad(value.sum(), leaf)
    with torch.no_grad():
        found = negative_log_likelihood(
            residual.masked_fill(~kept, torch.nan),
            covariance.clone(),
            trend=Trend(trend, torch.tensor([1.0, 0.3], dtype=torch.float64)),
            derivatives=True,
        )
    torch.testing.assert_close(found.value, value.detach())
    symmetric = (by_covariance + by_covariance.mT) / 2
    torch.testing.assert_close(found.by_covariance, symmetric, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("with_least", [False, True])
def test_missing_targets_do_not_count(problem, with_least):
    residual, covariance, basis = problem
    missing = torch.zeros(3, n, dtype=torch.bool)
    missing[0, 1] = missing[0, 4] = missing[2, 6] = True
    bound = least() if with_least else None
    found = negative_log_likelihood(
        residual.masked_fill(missing, torch.nan), covariance.clone(), basis, bound, derivatives=True
    )
    assert (found.by_mean[missing] == 0).all()
    for i in range(3):
        kept = (~missing[i]).nonzero().squeeze(-1)
        alone = negative_log_likelihood(
            residual[i, kept],
            covariance[i][kept][:, kept],
            basis[i, kept],
            None if bound is None else bound[i],
            derivatives=True,
        )
        torch.testing.assert_close(found.value[i], alone.value, rtol=1e-9, atol=0)
        torch.testing.assert_close(found.scale[i], alone.scale, rtol=1e-9, atol=0)
        torch.testing.assert_close(found.by_mean[i, kept], alone.by_mean, rtol=1e-8, atol=1e-10)
        by_covariance = torch.zeros(n, n, dtype=torch.float64)
        by_covariance[kept.unsqueeze(-1), kept] = alone.by_covariance
        torch.testing.assert_close(found.by_covariance[i], by_covariance, rtol=1e-8, atol=1e-10)


def test_residuals_explained_and_covariances_without_a_factor(problem):
    _, covariance, basis = problem
    residual = basis @ torch.tensor([2.0, -3.0], dtype=torch.float64)
    found = negative_log_likelihood(residual, covariance, basis, 1e-30 * least(), derivatives=True)
    assert found.value.isfinite().all()
    assert (found.scale > 0).all()
    residual, covariance, _ = problem
    covariance[1] = -covariance[1]
    found = negative_log_likelihood(residual, covariance, derivatives=True)
    assert found.value.isfinite().tolist() == [True, False, True]
    assert found.value[1] == math.inf


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_the_nugget_is_always_there_and_follows_the_diagonal(scale):
    size = 4
    ones = torch.full((2, size, size), scale, dtype=torch.float64)
    ones[1] += scale * torch.eye(size, dtype=torch.float64)
    sd = scale * torch.tensor([1.0, 1.0, 1.0, 1e-3], dtype=torch.float64)
    covariance = ones / scale * sd.unsqueeze(-1) * sd
    chol, failed = cholesky(covariance.clone())
    assert not failed.any()
    variance = covariance.diagonal(dim1=-1, dim2=-2)
    added = (chol @ chol.mT - covariance) / (variance.unsqueeze(-1) * variance.unsqueeze(-2)).sqrt()
    expected = nugget(size) * torch.eye(size, dtype=torch.float64).expand(2, size, size)
    torch.testing.assert_close(added, expected, rtol=0, atol=1e-15)


def test_the_nugget_is_raised_where_it_must_be():
    slightly_negative = torch.ones(4, 4, dtype=torch.float64)
    slightly_negative[0, 0] -= 1e-11
    chol, failed = cholesky(slightly_negative.clone())
    assert not failed
    torch.testing.assert_close(chol @ chol.mT, slightly_negative, rtol=0, atol=1e-9)


class TestLeastSquares:
    def test_least_squares(self, problem):
        residual, covariance, basis = problem
        coefficients, uncertainty = least_squares(
            torch.linalg.cholesky(covariance), residual, basis
        )
        weight = torch.linalg.inv(covariance)
        expected = torch.linalg.inv(basis.mT @ weight @ basis)
        torch.testing.assert_close(uncertainty, expected, rtol=1e-10, atol=1e-12)
        beta = expected @ basis.mT @ weight @ residual.unsqueeze(-1)
        torch.testing.assert_close(coefficients, beta.squeeze(-1), rtol=1e-10, atol=1e-12)
        chol = torch.linalg.cholesky(covariance)
        first = basis[..., 0]
        columns = torch.stack([first, 3 * first, torch.zeros_like(first)], dim=-1)
        coefficients, uncertainty = least_squares(chol, residual, columns)
        one, _ = least_squares(chol, residual, basis[..., :1])
        explained = (columns @ coefficients.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(explained, first * one)
        assert (coefficients[..., 2] == 0).all()
        assert uncertainty.isfinite().all()
