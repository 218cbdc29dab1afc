"""The kernel f_p(x) k(x, x') f_p(x')."""

from unittest import TestCase

import pytest
import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.test.base_kernel_test_case import BaseKernelTestCase
from gpytorch.test.base_mean_test_case import BaseMeanTestCase

from gpadjust.gp import PhysicsMean, PhysicsScaledKernel
from tests.systems import refused


def physics(X):
    return 1 + X.sum(-1).sin()


class TestAsGPyTorchsKernels(BaseKernelTestCase, TestCase):
    def create_kernel_no_ard(self, **kwargs):
        active_dims = kwargs.pop("active_dims", None)
        return PhysicsScaledKernel(RBFKernel(**kwargs), physics, active_dims=active_dims)

    def create_kernel_ard(self, num_dims, **kwargs):
        return PhysicsScaledKernel(RBFKernel(ard_num_dims=num_dims, **kwargs), physics)


def test_the_formula(uniform):
    base = MaternKernel(ard_num_dims=2).double()
    X, Z = uniform(5, 2), uniform(4, 2, seed=1)
    expected = physics(X)[:, None] * base(X, Z).to_dense() * physics(Z)[None, :]
    torch.testing.assert_close(PhysicsScaledKernel(base, physics)(X, Z).to_dense(), expected)


def test_the_diagonal_does_not_build_the_matrix(uniform):
    X = uniform(200_000, 2)  # the matrix would take 320 GB
    kernel = PhysicsScaledKernel(ScaleKernel(RBFKernel()), physics).double()
    assert kernel(X, diag=True).shape == (200_000,)
    small = X[:6]
    expected = kernel(small).to_dense().diagonal()
    torch.testing.assert_close(kernel(small, diag=True), expected)


def test_one_output_of_several(uniform):
    X = uniform(5, 2)
    pair = PhysicsScaledKernel(RBFKernel().double(), lambda X: X + 1, output=1)
    single = PhysicsScaledKernel(RBFKernel().double(), lambda X: X[..., 1] + 1)
    torch.testing.assert_close(pair(X).to_dense(), single(X).to_dense())
    kernel = PhysicsScaledKernel(RBFKernel().double(), lambda X: X)
    refused(ValueError, r"2 outputs.*`output=`", kernel(uniform(5, 2)).to_dense)
    kernel = PhysicsScaledKernel(RBFKernel().double(), physics)
    with pytest.raises(ValueError, match="last_dim_is_batch"):
        kernel.forward(uniform(5, 2), uniform(5, 2), last_dim_is_batch=True)
    assert not PhysicsScaledKernel(RBFKernel(), physics).is_stationary


# The physics as a mean function


class TestAsGPyTorchsMeans(BaseMeanTestCase, TestCase):
    def create_mean(self):
        return PhysicsMean(lambda X: X.sum(-1))

    test_forward_vec = None  # f_p takes rows; a GPyTorch model passes n x d


def test_values_and_parameters_of_the_mean(uniform):
    X = uniform(3, 4, 2)
    mean = PhysicsMean(lambda X: X.square(), output=1)
    torch.testing.assert_close(mean(X), X[..., 1].square())

    class Gain(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.tensor(2.0))

        def forward(self, X):
            return self.gain * X[:, 0]

    mean = PhysicsMean(Gain())
    assert [p.item() for p in mean.parameters()] == [2.0]
    mean(torch.ones(3, 1)).sum().backward()
    assert next(mean.parameters()).grad.item() == 3.0
