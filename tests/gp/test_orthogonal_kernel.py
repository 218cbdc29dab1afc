"""The kernel of functions that are orthogonal to directions."""

from math import nan
from unittest import TestCase

import pytest
import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.test.base_kernel_test_case import BaseKernelTestCase
from torch import Size

from gpadjust import CKA, PhysicsMeanGP
from gpadjust.gp import OrthogonalKernel, VanishingKernel
from gpadjust.models import orthogonal_rbf
from tests.systems import refused


class TestAsGPyTorchsKernels(BaseKernelTestCase, TestCase):
    def create_kernel_no_ard(self, **kwargs):
        return OrthogonalKernel(RBFKernel(**kwargs))

    def create_kernel_ard(self, num_dims, **kwargs):
        return self.create_kernel_no_ard(ard_num_dims=num_dims, **kwargs)


@pytest.fixture
def kernel():
    """Makes a kernel of inputs with two columns: `kernel(batch_shape)`."""

    def make(batch_shape=(), base_class=RBFKernel):
        shape = Size(batch_shape)
        base = ScaleKernel(base_class(ard_num_dims=2, batch_shape=shape), batch_shape=shape)
        base = base.double()
        sizes = torch.arange(1.0, 1 + shape.numel()).reshape(shape)
        base.outputscale = sizes
        base.base_kernel.lengthscale = 0.4 * sizes[..., None, None].expand(*shape, 1, 2)
        return OrthogonalKernel(base)

    return make


def dense(base, Z, G, X, W):
    """Plumlee's formula without a Cholesky factor."""

    def k(A, B):
        return base(A, B).to_dense()

    inner = torch.linalg.inv(G.mT @ k(Z, Z) @ G)
    return k(X, W) - k(X, Z) @ G @ inner @ G.mT @ k(Z, W)


@pytest.mark.parametrize("base_class", [RBFKernel, MaternKernel])
def test_the_formula(kernel, uniform, base_class):
    plain, Z, G = kernel(base_class=base_class), uniform(9, 2), uniform(9, 3, seed=1, low=-5.0)
    X, W = uniform(6, 2, seed=2), uniform(4, 2, seed=3)
    plain.set_directions(Z, G)
    expected = dense(plain.base_kernel, Z, G, X, W)
    torch.testing.assert_close(plain(X, W).to_dense(), expected, rtol=0, atol=1e-7)
    square = plain(X).to_dense()
    torch.testing.assert_close(square, dense(plain.base_kernel, Z, G, X, X), rtol=0, atol=1e-7)
    torch.testing.assert_close(plain(X, diag=True), square.diagonal())
    assert torch.linalg.eigvalsh(square).min() > -1e-9
    assert (square.diagonal() < plain.base_kernel(X, diag=True)).all()
    plain, Z, G, X = kernel(), uniform(9, 2), uniform(9, 3, seed=1), uniform(6, 2, seed=2)
    plain.set_directions(Z, G)
    assert (G.mT @ plain(Z, X).to_dense()).abs().max() < 1e-8
    assert torch.linalg.eigvalsh(plain(Z).to_dense()).min() > -1e-9


def test_directions_that_do_not_matter(kernel, uniform):
    plain, Z, G, X = kernel(), uniform(9, 2), uniform(9, 2, seed=1), uniform(6, 2, seed=2)
    plain.set_directions(Z, G)
    expected = plain(X).to_dense()
    for others in (G * 1e6, G * torch.tensor([1e-9, 1.0]), G[:, [0, 1, 0]]):
        plain.set_directions(Z, others)
        torch.testing.assert_close(plain(X).to_dense(), expected, rtol=0, atol=1e-6)
    plain, Z, G, X = kernel(), uniform(9, 2), uniform(9, 1, seed=1), uniform(6, 2, seed=2)
    plain.set_directions(Z, G)
    expected = plain(X).to_dense()
    plain.set_directions(Z, torch.cat([G, torch.zeros_like(G)], -1))
    torch.testing.assert_close(plain(X).to_dense(), expected, rtol=0, atol=1e-8)


def test_without_directions_it_is_the_base_kernel(kernel, uniform):
    plain, X, W = kernel((2,)), uniform(6, 2), uniform(4, 2, seed=1)
    assert torch.equal(plain(X, W).to_dense(), plain.base_kernel(X, W).to_dense())
    assert torch.equal(plain(X, diag=True), plain.base_kernel(X, diag=True))
    assert plain.batch_shape == (2,)
    assert not plain.is_stationary


def test_a_batch(kernel, uniform):
    several, X, G = kernel((2,)), uniform(6, 2, seed=2), uniform(2, 9, 3, seed=1)
    several.set_directions(uniform(1, 9, 2), G)  # the same points for both
    values = several(X).to_dense()
    assert values.shape == (2, 6, 6)
    for j in range(2):
        alone = several[j]
        assert alone.batch_shape == ()
        base = alone.base_kernel
        expected = dense(base, uniform(9, 2), G[j], X, X)
        torch.testing.assert_close(values[j], expected, rtol=0, atol=1e-7)
        torch.testing.assert_close(alone(X).to_dense(), values[j])
        torch.testing.assert_close(several(X)[j].to_dense(), values[j])
    order = torch.tensor([1, 0, 1])
    torch.testing.assert_close(several[order](X).to_dense(), values[order])
    for shape in ([3, 2], [4, 1, 2]):
        wide = several.expand_batch(Size(shape))
        assert wide.batch_shape == tuple(shape)
        torch.testing.assert_close(wide(X).to_dense(), values.expand(*shape, 6, 6))
        assert several.expand_batch(*shape).batch_shape == tuple(shape)
    assert several.batch_shape == (2,)


def test_gradients_and_states(kernel, uniform):
    plain, X = kernel(), uniform(4, 2).requires_grad_()
    plain.set_directions(uniform(9, 2, seed=1), uniform(9, 2, seed=2))
    assert torch.autograd.gradcheck(lambda X: plain(X).to_dense(), X)
    plain(X).to_dense().square().sum().backward()
    assert plain.base_kernel.raw_outputscale.grad.abs() > 0
    assert plain.base_kernel.base_kernel.raw_lengthscale.grad.abs().min() > 0
    plain, other, X = kernel(), kernel(), uniform(6, 2)
    plain.set_directions(uniform(9, 2, seed=1), uniform(9, 3, seed=2))
    other.set_directions(uniform(5, 2), uniform(5, 1))
    for state, expected in ((plain.state_dict(), plain), (kernel().state_dict(), kernel())):
        other.load_state_dict(state)
        torch.testing.assert_close(other(X).to_dense(), expected(X).to_dense())


class TestModels:
    """Models whose delta is orthogonal, with directions set by hand."""

    @staticmethod
    def of(make, num_outputs, uniform):
        X = uniform(9, 2)
        Y = torch.stack([X[:, 0].sin(), X[:, 1].square()], -1)[:, :num_outputs]
        model = make(X, Y, physics=lambda X: X[:, :num_outputs])
        (delta,) = (term.kernel for term in model.terms if term.name == "delta")
        G = uniform(num_outputs, 9, 2, seed=1).squeeze(0)
        delta.set_directions(X, G)
        return model.eval(), X, G

    @pytest.mark.parametrize("num_outputs", [1, 2])
    def test_sampled_functions_have_the_posterior(self, num_outputs, uniform):
        def make(*data, **options):
            return CKA(*data, delta_covar_module=orthogonal_rbf, **options)

        model, _, _ = self.of(make, num_outputs, uniform)
        Z = uniform(3, 2, seed=4)
        with torch.no_grad():
            values, posterior = model.sample_functions(1500, seed=0)(Z), model.posterior(Z)
        sd = posterior.variance.max().sqrt().item()
        torch.testing.assert_close(values.mean(0), posterior.mean, rtol=0, atol=0.15 * sd)
        variance = values.var(0)
        torch.testing.assert_close(variance, posterior.variance, rtol=0, atol=0.2 * sd**2)

    @pytest.mark.parametrize("num_outputs", [1, 2])
    def test_nothing_is_left_of_functions_along_the_directions(self, num_outputs, uniform):
        def make(*data, **options):
            return PhysicsMeanGP(*data, covar_module=orthogonal_rbf, **options)

        model, X, G = self.of(make, num_outputs, uniform)
        G = G.reshape(num_outputs, 9, 2)
        with torch.no_grad():
            values = model.sample_functions(4, seed=0)(X) - X[:, :num_outputs]
            mean, term = model.posterior(X).mean - X[:, :num_outputs], model.delta(X)
        assert values.std(0).min() > 0
        for found in (values, mean.unsqueeze(0), term.mean.unsqueeze(0)):
            along = torch.einsum("mnp,knm->kmp", G, found)
            assert along.abs().max() < 1e-6 * found.abs().max()
        for j in range(num_outputs):
            covariance = term.distribution.covariance_matrix
            own = covariance[9 * j : 9 * (j + 1), 9 * j : 9 * (j + 1)]
            if num_outputs > 1 and term.distribution._interleaved:
                own = covariance[j::num_outputs, j::num_outputs]
            assert (G[j].mT @ own @ G[j]).abs().max() < 1e-6 * own.abs().max()


# The kernel of functions that are zero at given values of some inputs


def base_of(shape=(), base_class=RBFKernel, d=3):
    shape = Size(shape)
    base = ScaleKernel(base_class(ard_num_dims=d, batch_shape=shape), batch_shape=shape).double()
    sizes = torch.arange(1.0, 1 + shape.numel()).reshape(shape)
    base.outputscale = 2 * sizes
    base.base_kernel.lengthscale = torch.tensor([0.4, 0.6, 0.9][:d]) * sizes[..., None, None]
    return base


PLACES = {
    "hyperplane": [[nan, 0.3, nan]],
    "two hyperplanes": [[nan, 0.0, nan], [nan, 1.0, nan]],
    "edge": [[0.2, nan, 0.7]],
    "point": [[0.2, 0.3, 0.7]],
    "points": [[0.2, 0.3, 0.7], [0.9, 0.1, 0.4]],
}


@pytest.mark.parametrize("places", PLACES.values(), ids=PLACES)
def test_it_is_the_base_kernel_conditioned_on_zeros(places, uniform):
    """A dense net of zeros on the set, at the values that x and x' have of the other inputs."""
    base, places = base_of(), torch.tensor(places).double()
    kernel, X, W = VanishingKernel(base, places), uniform(5, 3), uniform(4, 3, seed=1)
    both = torch.cat([X, W])
    zeros = torch.cat([both.where(place.isnan(), place) for place in places])
    zeros = torch.unique(zeros, dim=0)

    def k(A, B):
        return base(A, B).to_dense()

    inner = torch.linalg.pinv(k(zeros, zeros), hermitian=True, rtol=1e-12)
    expected = k(X, W) - k(X, zeros) @ inner @ k(zeros, W)
    torch.testing.assert_close(kernel(X, W).to_dense(), expected, rtol=0, atol=1e-7)
    square = kernel(X).to_dense()
    torch.testing.assert_close(kernel(X, diag=True), square.diagonal())
    assert torch.linalg.eigvalsh(square).min() > -1e-9
    assert kernel(zeros, W).to_dense().abs().max() < 1e-8
    assert kernel(zeros, diag=True).max() < 1e-8


def test_far_from_there_and_in_a_batch(uniform):
    base, X = base_of(), uniform(5, 3)
    kernel = VanishingKernel(base, torch.tensor([[nan, 50.0, nan]]).double())
    torch.testing.assert_close(kernel(X).to_dense(), base(X).to_dense())
    several = VanishingKernel(base_of((2,)), torch.tensor([[nan, 0.3, nan]]).double())
    X = uniform(6, 3, seed=2)
    values = several(X).to_dense()
    for j in range(2):
        torch.testing.assert_close(several[j](X).to_dense(), values[j])
    wide = several.expand_batch(Size([3, 2]))
    torch.testing.assert_close(wide(X).to_dense(), values.expand(3, 2, 6, 6))


def test_any_kernel_of_points_and_rbf_kernels_else(uniform):
    matern, X = base_of(base_class=MaternKernel), uniform(5, 3)
    kernel = VanishingKernel(matern, X[:2])
    assert kernel(X, diag=True)[:2].max() < 1e-8 < kernel(X, diag=True)[2:].min()
    with pytest.raises(ValueError, match=r"RBF kernel.*product.*ScaleKernel"):
        VanishingKernel(matern, torch.tensor([[nan, 0.3, nan]]))
    for places in ([[nan, nan, nan]], [[nan, 1.0, nan], [1.0, nan, nan]], [1.0, 2.0, 3.0]):
        with pytest.raises(ValueError, match="places as p x d numbers"):
            VanishingKernel(base_of(), torch.tensor(places))


def test_gradients_and_states_where_it_vanishes(uniform):
    kernel = VanishingKernel(base_of(), torch.tensor([[nan, 0.3, nan]]).double())
    X = uniform(4, 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda X: kernel(X).to_dense(), X)
    kernel(X).to_dense().square().sum().backward()
    assert kernel.base_kernel.base_kernel.raw_lengthscale.grad.abs().min() > 0
    one, other = (VanishingKernel(base_of(), torch.tensor([[nan, v, nan]])) for v in (0.0, 1.0))
    refused(ValueError, r"zero elsewhere", one.load_state_dict, other.state_dict())
