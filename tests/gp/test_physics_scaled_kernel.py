"""The kernel f_p(x) k(x, x') f_p(x')."""

from unittest import TestCase

import pytest
import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.test.base_kernel_test_case import BaseKernelTestCase
from torch import Size

from gpadjust.gp import InputsKernel, PhysicsColumn, PhysicsScaledKernel


def physics(X):
    return 1 + X.sum(-1).sin()


class TestAsGPyTorchsKernels(BaseKernelTestCase, TestCase):
    def create_kernel_no_ard(self, **kwargs):
        active_dims = kwargs.pop("active_dims", None)
        return PhysicsScaledKernel(RBFKernel(**kwargs), physics, active_dims=active_dims)

    def create_kernel_ard(self, num_dims, **kwargs):
        return PhysicsScaledKernel(RBFKernel(ard_num_dims=num_dims, **kwargs), physics)


class TestInputsKernelAsGPyTorchsKernels(BaseKernelTestCase, TestCase):
    def create_kernel_no_ard(self, **kwargs):
        return InputsKernel(RBFKernel(**kwargs), num_inputs=10)

    def create_kernel_ard(self, num_dims, **kwargs):
        return InputsKernel(RBFKernel(ard_num_dims=num_dims, **kwargs), num_inputs=10)


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


def test_several_outputs_without_saying_which(uniform):
    kernel = PhysicsScaledKernel(RBFKernel().double(), lambda X: X)
    with pytest.raises(ValueError, match="has 2 outputs; say with `output=`"):
        kernel(uniform(5, 2)).to_dense()


def test_last_dim_is_batch(uniform):
    kernel = PhysicsScaledKernel(RBFKernel().double(), physics)
    with pytest.raises(ValueError, match="cannot take `last_dim_is_batch=True`"):
        kernel.forward(uniform(5, 2), uniform(5, 2), last_dim_is_batch=True)


def test_it_is_not_stationary():
    assert not PhysicsScaledKernel(RBFKernel(), physics).is_stationary
    assert InputsKernel(RBFKernel(), 2).is_stationary


@pytest.fixture
def columns(uniform):
    """Two kernels in a batch that read two columns of f_p, and inputs that have them."""
    base = RBFKernel(batch_shape=Size([2])).double()
    base.lengthscale = torch.tensor([0.4, 0.9]).reshape(2, 1, 1)
    column = PhysicsColumn(
        3,
        2,
        Size([2]),
        offset=torch.tensor([[0.1], [0.2]], dtype=torch.float64),
        scale=torch.tensor([[2.0], [3.0]], dtype=torch.float64),
    )
    return PhysicsScaledKernel(InputsKernel(base, 3), column), uniform(6, 5)


def expected_of(kernel, X, j):
    f_p = (X[:, 3 + j] - [0.1, 0.2][j]) / [2.0, 3.0][j]
    base = RBFKernel().double()
    base.lengthscale = [0.4, 0.9][j]
    return f_p[:, None] * base(X[:, :3]).to_dense() * f_p[None, :]


@pytest.mark.parametrize("j", [0, 1])
def test_a_batch_reads_its_own_column(columns, j):
    kernel, X = columns
    assert kernel.batch_shape == (2,)
    torch.testing.assert_close(kernel(X).to_dense()[j], expected_of(kernel, X, j))


@pytest.mark.parametrize("j", [0, 1])
def test_getitem(columns, j):
    kernel, X = columns
    part = kernel[j]
    assert part.batch_shape == ()
    torch.testing.assert_close(part(X).to_dense(), expected_of(kernel, X, j))
    torch.testing.assert_close(kernel(X)[j].to_dense(), expected_of(kernel, X, j))


def test_getitem_of_several(columns):
    kernel, X = columns
    part = kernel[torch.tensor([1, 0, 1])]
    assert part.batch_shape == (3,)
    for i, j in enumerate((1, 0, 1)):
        torch.testing.assert_close(part(X).to_dense()[i], expected_of(kernel, X, j))


@pytest.mark.parametrize("shape", [Size([4, 2]), Size([3, 1, 2])])
def test_expand_batch(columns, shape):
    kernel, X = columns
    wide = kernel.expand_batch(shape)
    assert wide.batch_shape == shape
    values = wide(X).to_dense()
    assert values.shape == (*shape, 6, 6)
    for j in range(2):
        expected = expected_of(kernel, X, j).expand(*shape[:-1], 6, 6)
        torch.testing.assert_close(values[..., j, :, :], expected)


def test_expand_batch_leaves_the_kernel(columns):
    kernel, X = columns
    kernel.expand_batch(Size([4, 2]))
    assert kernel.batch_shape == (2,)
    assert kernel(X).to_dense().shape == (2, 6, 6)


def test_gradients_reach_hyper_parameters_and_inputs(uniform):
    kernel = PhysicsScaledKernel(RBFKernel().double(), physics)
    X = uniform(5, 2).requires_grad_()
    kernel(X).to_dense().sum().backward()
    assert kernel.base_kernel.raw_lengthscale.grad.abs() > 0
    assert X.grad.abs().max() > 0
