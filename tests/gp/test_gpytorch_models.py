"""The pieces in plain GPyTorch models, exact and variational."""

from unittest import TestCase

import gpytorch
import pytest
import torch
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.test.model_test_case import BaseModelTestCase, VariationalModelTestCase
from gpytorch.variational import CholeskyVariationalDistribution, VariationalStrategy
from torch import Size

from gpadjust.gp import PhysicsMean, PhysicsScaledKernel


def physics(X):
    return 1 + X.sum(-1).sin()


class Exact(gpytorch.models.ExactGP):
    def __init__(self, train_x, train_y, likelihood, batch_shape=Size()):  # noqa: B008
        super().__init__(train_x, train_y, likelihood)
        self.mean_module = PhysicsMean(physics)
        rho = RBFKernel(batch_shape=batch_shape)
        self.covar_module = PhysicsScaledKernel(rho, physics) + RBFKernel(batch_shape=batch_shape)

    def forward(self, x):
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


class Variational(gpytorch.models.ApproximateGP):
    def __init__(self, inducing_points):
        distribution = CholeskyVariationalDistribution(
            inducing_points.size(-2), batch_shape=inducing_points.shape[:-2]
        )
        super().__init__(VariationalStrategy(self, inducing_points, distribution))
        self.mean_module = PhysicsMean(physics)
        self.covar_module = PhysicsScaledKernel(RBFKernel(), physics) + ScaleKernel(RBFKernel())

    def forward(self, x):
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


class Data:
    def create_test_data(self):
        return torch.randn(50, 1)

    def create_likelihood_and_labels(self):
        return GaussianLikelihood(), torch.randn(50) + 2

    def create_batch_test_data(self, batch_shape=Size([3])):  # noqa: B008
        return torch.randn(*batch_shape, 50, 1)

    def create_batch_likelihood_and_labels(self, batch_shape=Size([3])):  # noqa: B008
        return GaussianLikelihood(batch_shape=batch_shape), torch.randn(*batch_shape, 50) + 2


@pytest.mark.filterwarnings("ignore:The input matches the stored training data")
class TestExactGP(Data, BaseModelTestCase, TestCase):
    def create_model(self, train_x, train_y, likelihood):
        return Exact(train_x, train_y, likelihood, batch_shape=train_y.shape[:-1])


class TestVariationalGP(Data, VariationalModelTestCase, TestCase):
    def create_model(self, train_x, train_y, likelihood):
        return Variational(train_x[..., ::5, :].clone())


def test_the_exact_model_is_co_kriging(uniform):
    X, Z = uniform(8, 1), uniform(5, 1, low=-1, high=2, seed=1)
    y = 1.4 * physics(X) + X[:, 0]
    likelihood = GaussianLikelihood().double()
    likelihood.noise = 0.01
    model = Exact(X, y, likelihood).double().eval()
    k = RBFKernel().double()
    f_x, f_z = physics(X), physics(Z)

    def prior(a, b, f_a, f_b):
        return f_a[:, None] * k(a, b).to_dense() * f_b[None, :] + k(a, b).to_dense()

    K = prior(X, X, f_x, f_x) + 0.01 * torch.eye(8)
    cross = prior(Z, X, f_z, f_x)
    posterior = model(Z)
    mean = f_z + cross @ torch.linalg.solve(K, y - f_x)
    torch.testing.assert_close(posterior.mean, mean, rtol=1e-7, atol=1e-7)
    variance = (prior(Z, Z, f_z, f_z) - cross @ torch.linalg.solve(K, cross.mT)).diagonal()
    torch.testing.assert_close(posterior.variance, variance, rtol=1e-6, atol=1e-8)
