"""Random Fourier features and their kernel."""

from unittest import TestCase

import pytest
import torch
from gpytorch.kernels import RBFKernel
from gpytorch.test.base_kernel_test_case import BaseKernelTestCase
from torch import Size

from gpadjust.gp import FourierFeatures, FourierKernel


class TestAsGPyTorchsKernels(BaseKernelTestCase, TestCase):
    def create_kernel_no_ard(self, num_inputs=2, **kwargs):
        if kwargs.get("active_dims"):
            num_inputs = len(kwargs["active_dims"])
        return FourierKernel(FourierFeatures(8, num_inputs).float(), **kwargs)

    def create_kernel_ard(self, num_dims, **kwargs):
        return FourierKernel(FourierFeatures(8, num_dims).float(), ard_num_dims=num_dims, **kwargs)

    def test_active_dims_list(self):
        x = self.create_data_no_batch()
        kernel = self.create_kernel_no_ard(active_dims=[0, 2, 4, 6])
        basic = self.create_kernel_no_ard(num_inputs=4)
        self.assertAllClose(kernel(x).to_dense(), basic(x[:, [0, 2, 4, 6]]).to_dense())

    def test_active_dims_range(self):
        x = self.create_data_no_batch()
        kernel = self.create_kernel_no_ard(active_dims=list(range(3, 9)))
        basic = self.create_kernel_no_ard(num_inputs=6)
        self.assertAllClose(kernel(x).to_dense(), basic(x[:, 3:9]).to_dense())


def test_it_tends_to_the_rbf_kernel(uniform):
    X = uniform(20, 3)
    rbf = RBFKernel(ard_num_dims=3).double()
    rbf.lengthscale = torch.tensor([0.3, 0.5, 2.0])

    def error(num_features):
        kernel = FourierKernel(FourierFeatures(num_features, 3), ard_num_dims=3).double()
        kernel.lengthscale = rbf.lengthscale
        return (kernel(X).to_dense() - rbf(X).to_dense()).abs().max().item()

    assert error(100_000) < 0.02
    assert error(10) > 0.1


def test_features_make_the_kernel(uniform):
    X, Z = uniform(5, 2), uniform(4, 2, seed=1)
    kernel = FourierKernel(FourierFeatures(7, 2), ard_num_dims=2).double()
    kernel.lengthscale = torch.tensor([0.3, 0.5])
    phi = kernel.feature_map
    assert phi(X).shape == (5, 7)
    torch.testing.assert_close(kernel(X, Z).to_dense(), phi(X) @ phi(Z).mT)
    torch.testing.assert_close(kernel(X, diag=True), phi(X).square().sum(-1))


def test_a_batch_shares_the_draw_but_not_the_lengthscale(uniform):
    X = uniform(5, 2)
    features = FourierFeatures(7, 2)
    kernel = FourierKernel(features, batch_shape=Size([2])).double()
    kernel.lengthscale = torch.tensor([0.3, 0.9], dtype=torch.float64).reshape(2, 1, 1)
    for j, length in enumerate((0.3, 0.9)):
        torch.testing.assert_close(kernel.feature_map(X)[j], features(X / length))


@pytest.mark.parametrize("seed", [0, 3])
def test_the_seed_makes_the_draw(seed):
    state = torch.get_rng_state()
    first, same = FourierFeatures(5, 2, seed), FourierFeatures(5, 2, seed)
    assert torch.equal(first.frequencies, same.frequencies)
    assert torch.equal(first.phases, same.phases)
    assert not torch.equal(first.frequencies, FourierFeatures(5, 2, seed + 1).frequencies)
    assert torch.equal(torch.get_rng_state(), state)
