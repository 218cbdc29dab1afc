"""The kernel of functions that are zero at given values of some inputs."""

from math import nan

import pytest
import torch
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from torch import Size

from gpadjust.gp import VanishingKernel
from tests.systems import refused


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


def test_gradients_and_states(uniform):
    kernel = VanishingKernel(base_of(), torch.tensor([[nan, 0.3, nan]]).double())
    X = uniform(4, 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda X: kernel(X).to_dense(), X)
    kernel(X).to_dense().square().sum().backward()
    assert kernel.base_kernel.base_kernel.raw_lengthscale.grad.abs().min() > 0
    one, other = (VanishingKernel(base_of(), torch.tensor([[nan, v, nan]])) for v in (0.0, 1.0))
    refused(ValueError, r"zero elsewhere", one.load_state_dict, other.state_dict())
