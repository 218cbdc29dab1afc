"""The closed-form likelihood against scipy, autograd and textbook generalised least squares."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import multivariate_normal

from gpadjust.inference.gaussian_likelihood import (
    least_squares,
    negative_log_likelihood,
    safe_cholesky,
)

n, q = 7, 2


@pytest.fixture
def problem(uniform):
    """A batch of three residuals and covariances, and a basis."""
    factor = uniform(3, n, n, low=-1, seed=1)
    covariance = factor @ factor.mT + 0.3 * torch.eye(n, dtype=torch.float64)
    return 3 * uniform(3, n, low=-1, seed=2), covariance, uniform(3, n, q, low=-1, seed=3)


def density(residual, covariance):
    """Scipy's negative log density."""
    return -multivariate_normal(cov=covariance.numpy()).logpdf(residual.numpy())


def formula(residual, covariance, basis=None, concentrated=False):
    """The same likelihood from inverses and determinants, for autograd."""
    inverse = torch.linalg.inv(covariance)
    if basis is not None:
        inside = torch.linalg.inv(basis.mT @ inverse @ basis)
        inverse = inverse - inverse @ basis @ inside @ basis.mT @ inverse
    square = (residual.unsqueeze(-2) @ inverse @ residual.unsqueeze(-1))[..., 0, 0]
    fit = n * (1 + (square / n).log()) if concentrated else square
    return 0.5 * (fit + torch.logdet(covariance) + n * math.log(2 * math.pi))


def test_it_is_scipys_normal_density(problem):
    residual, covariance, _ = problem
    values = negative_log_likelihood(residual, covariance).value
    expected = [density(*each) for each in zip(residual, covariance, strict=True)]
    np.testing.assert_allclose(values.numpy(), expected, rtol=1e-12)


def test_concentrated_it_is_the_least_over_a_factor(problem):
    residual, covariance, _ = problem
    found = negative_log_likelihood(residual, covariance, concentrated=True)
    for i in range(3):

        def at(log_scale, i=i):
            return density(residual[i], math.exp(log_scale) * covariance[i])

        best = minimize_scalar(at, bounds=(-20, 20), method="bounded", options={"xatol": 1e-9})
        assert found.value[i].item() == pytest.approx(best.fun, rel=1e-10)
        assert found.scale[i].log().item() == pytest.approx(best.x, abs=1e-6)


def test_with_a_basis_it_is_the_least_over_its_coefficients(problem):
    residual, covariance, basis = problem
    found = negative_log_likelihood(residual, covariance, basis)
    for i in range(3):

        def at(beta, i=i):
            return density(residual[i] - basis[i] @ torch.from_numpy(beta), covariance[i])

        best = minimize(at, np.zeros(q), options={"gtol": 1e-9})
        assert found.value[i].item() == pytest.approx(best.fun, rel=1e-10)


def test_with_both_it_is_the_least_over_coefficients_and_factor(problem):
    residual, covariance, basis = problem
    found = negative_log_likelihood(residual, covariance, basis, concentrated=True)
    for i in range(3):

        def at(free, i=i):
            rest = residual[i] - basis[i] @ torch.from_numpy(free[1:])
            return density(rest, math.exp(free[0]) * covariance[i])

        best = minimize(at, np.zeros(1 + q), method="BFGS", options={"gtol": 1e-7})
        assert found.value[i].item() == pytest.approx(best.fun, rel=1e-9)
        assert found.scale[i].log().item() == pytest.approx(best.x[0], abs=1e-4)


@pytest.mark.parametrize("concentrated", [False, True])
@pytest.mark.parametrize("with_basis", [False, True])
def test_derivatives_are_autograds(problem, concentrated, with_basis):
    residual, covariance, basis = problem
    basis = basis if with_basis else None
    mean = torch.zeros_like(residual).requires_grad_()
    covariance.requires_grad_()
    value = formula(residual - mean, covariance, basis, concentrated)
    by_mean, by_covariance = torch.autograd.grad(value.sum(), (mean, covariance))
    with torch.no_grad():
        found = negative_log_likelihood(residual, covariance, basis, concentrated, derivatives=True)
    torch.testing.assert_close(found.value, value.detach(), rtol=1e-10, atol=0)
    torch.testing.assert_close(found.gradient[0], by_mean, rtol=1e-6, atol=1e-9)
    symmetric = (by_covariance + by_covariance.mT) / 2
    torch.testing.assert_close(found.gradient[1], symmetric, rtol=1e-6, atol=1e-9)


def test_a_residual_that_the_basis_explains(problem):
    _, covariance, basis = problem
    residual = basis @ torch.tensor([2.0, -3.0], dtype=torch.float64)
    found = negative_log_likelihood(residual, covariance, basis, True, derivatives=True)
    assert found.value.isfinite().all()
    assert (found.scale > 0).all()


def test_a_covariance_without_a_factor_is_infinitely_bad(problem):
    residual, covariance, _ = problem
    covariance[1] = -covariance[1]
    found = negative_log_likelihood(residual, covariance, derivatives=True)
    assert found.value.isfinite().tolist() == [True, False, True]
    assert found.value[1] == math.inf


def test_a_singular_covariance_gets_jitter():
    ones = torch.ones(4, 4, dtype=torch.float64)
    chol, failed = safe_cholesky(ones)
    assert not failed.any()
    torch.testing.assert_close(chol @ chol.mT, ones, rtol=0, atol=1e-7)


class TestLeastSquares:
    def test_is_the_textbooks(self, problem):
        residual, covariance, basis = problem
        coefficients, uncertainty = least_squares(
            torch.linalg.cholesky(covariance), residual, basis
        )
        weight = torch.linalg.inv(covariance)
        expected = torch.linalg.inv(basis.mT @ weight @ basis)
        torch.testing.assert_close(uncertainty, expected, rtol=1e-10, atol=1e-12)
        beta = expected @ basis.mT @ weight @ residual.unsqueeze(-1)
        torch.testing.assert_close(coefficients, beta.squeeze(-1), rtol=1e-10, atol=1e-12)

    def test_collinear_columns_explain_as_much_as_one(self, problem):
        residual, covariance, basis = problem
        chol = torch.linalg.cholesky(covariance)
        twice = torch.stack([basis[..., 0], 3 * basis[..., 0]], dim=-1)
        coefficients, uncertainty = least_squares(chol, residual, twice)
        one, _ = least_squares(chol, residual, basis[..., :1])
        explained = (twice @ coefficients.unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(explained, basis[..., 0] * one)
        assert uncertainty.isfinite().all()

    def test_a_column_of_zeros_is_left_alone(self, problem):
        residual, covariance, basis = problem
        basis[..., 1] = 0.0
        coefficients, uncertainty = least_squares(
            torch.linalg.cholesky(covariance), residual, basis
        )
        assert (coefficients[..., 1] == 0).all()
        assert uncertainty.isfinite().all()
