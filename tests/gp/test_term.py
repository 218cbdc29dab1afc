"""Terms, and their sum as a GPyTorch kernel."""

from unittest import TestCase

import pytest
import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.test.base_kernel_test_case import BaseKernelTestCase
from torch import Size

from gpadjust.gp import AppendedPhysics, SumOfTerms, Term
from gpadjust.gp.term import TermsMean
from tests.systems import refused


def constant(*values):
    return torch.tensor(values, dtype=torch.float64)


class TestAsGPyTorchsKernels(BaseKernelTestCase, TestCase):
    def create_kernel_no_ard(self, **kwargs):
        mean = torch.zeros(*kwargs.get("batch_shape", ()), 1)
        return SumOfTerms([Term("f", RBFKernel(**kwargs), 10, None, mean, mean + 0.5)])

    def create_kernel_ard(self, num_dims, **kwargs):
        return self.create_kernel_no_ard(ard_num_dims=num_dims, **kwargs)


OFFSET, SCALE, LENGTH = (0.1, 0.2), (2.0, 3.0), (0.4, 0.9)
RHO, VARIANCE = (1.0, 3.0), (0.7, 0.0)


@pytest.fixture
def terms():
    """Rho and delta of two outputs in a batch, that read two columns of f_p."""
    rho = RBFKernel(batch_shape=Size([2])).double()
    rho.lengthscale = torch.tensor(LENGTH).reshape(2, 1, 1)
    select = torch.eye(2, dtype=torch.float64).unsqueeze(-2)
    columns = (constant(*values).unsqueeze(-1) for values in (OFFSET, SCALE, RHO, VARIANCE))
    offset, scale, mean, variance = columns
    basis = AppendedPhysics(3, select, offset, scale)
    delta = ScaleKernel(MaternKernel(batch_shape=Size([2])), batch_shape=Size([2])).double()
    return [
        Term("rho", rho, 3, basis, mean, variance),
        Term("delta", delta, 3, None, torch.zeros_like(mean)),
    ]


def expected_of(X, j):
    """Mean and covariance of output j in plain GPyTorch."""
    f_p = (X[:, 3 + j] - OFFSET[j]) / SCALE[j]
    rho, delta = RBFKernel().double(), ScaleKernel(MaternKernel()).double()
    rho.lengthscale = LENGTH[j]
    k_rho = rho(X[:, :3]).to_dense() + VARIANCE[j]
    return RHO[j] * f_p, f_p.outer(f_p) * k_rho + delta(X[:, :3]).to_dense()


@pytest.mark.parametrize("j", [0, 1])
def test_the_formula(terms, uniform, j):
    kernel, X = SumOfTerms(terms), uniform(6, 5)
    mean, expected = expected_of(X, j)
    assert kernel.batch_shape == (2,)
    assert not kernel.is_stationary
    torch.testing.assert_close(TermsMean(kernel)(X)[j], mean)
    torch.testing.assert_close(kernel(X).to_dense()[j], expected)
    torch.testing.assert_close(kernel(X, diag=True)[j], expected.diagonal())
    torch.testing.assert_close(kernel(X[:2], X[2:]).to_dense()[j], expected[:2, 2:])
    assert kernel[j].batch_shape == ()
    torch.testing.assert_close(kernel[j](X).to_dense(), expected)
    torch.testing.assert_close(kernel(X)[j].to_dense(), expected)
    several = kernel[torch.tensor([1, j])]
    assert several.batch_shape == (2,)
    torch.testing.assert_close(several(X).to_dense()[1], expected)
    for shape in ([4, 2], [3, 1, 2]):
        wide = kernel.expand_batch(Size(shape))
        assert wide.batch_shape == tuple(shape)
        values = wide(X).to_dense()[..., j, :, :]
        torch.testing.assert_close(values, expected.expand_as(values))
    assert kernel.batch_shape == (2,)


def test_known_means_and_terms_without_kernels(terms, uniform):
    X, rho = uniform(6, 5), terms[0]
    assert rho.learns_mean
    assert not terms[1].learns_mean
    unknown, known = (SumOfTerms([rho], known_means=k)(X).to_dense() for k in (False, True))
    f_p = rho.weights(X)
    added = constant(*VARIANCE)[:, None, None] * f_p.unsqueeze(-1) * f_p.unsqueeze(-2)
    torch.testing.assert_close(unknown - known, added)
    one, X = constant(1.0), uniform(5, 2)
    known, unknown = Term("known", None, 2, None, one), Term("f", None, 2, None, one, 2 * one)
    assert known.is_known
    assert not unknown.is_known
    expected = torch.full((5, 5), 2.0, dtype=torch.float64)
    torch.testing.assert_close(SumOfTerms([known, unknown])(X).to_dense(), expected)
    kernel, zero = SumOfTerms([known]), torch.zeros(5, 5, dtype=torch.float64)
    torch.testing.assert_close(kernel(X).to_dense(), zero)  # nothing is unknown
    torch.testing.assert_close(kernel(X, diag=True), zero[0])
    torch.testing.assert_close(kernel(X, uniform(3, 2)).to_dense(), zero[:, :3])


def test_gradients_and_what_is_refused(terms, uniform):
    X = uniform(4, 5).requires_grad_()
    SumOfTerms(terms)(X).to_dense().square().sum().backward()
    assert X.grad.abs().amax(0).min() > 0
    assert terms[0].kernel.raw_lengthscale.grad.abs().min() > 0
    one, kernel = constant(1.0), RBFKernel()
    with pytest.raises(ValueError, match="different names"):
        SumOfTerms([Term("f", kernel, 2, None, one), Term("f", RBFKernel(), 2, None, one)])
    with pytest.raises(ValueError, match="share parameters"):
        SumOfTerms([Term("f", kernel, 2, None, one), Term("g", kernel, 2, None, one)])
    refused(ValueError, r"3 input columns and 2 .*f_p", SumOfTerms(terms)(uniform(6, 3)).to_dense)
