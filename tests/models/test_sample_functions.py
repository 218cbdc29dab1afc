"""Functions drawn from the posterior, and BoTorch's pathwise sampling."""

import copy

import pytest
import torch
from botorch.models.deterministic import MatheronPathModel
from botorch.models.transforms import Normalize
from botorch.sampling.pathwise import draw_kernel_feature_paths, draw_matheron_paths
from gpytorch.kernels import ConstantKernel, RBFKernel

from gpadjust.gp import FourierFeatures, FourierKernel, InputsKernel, PhysicsScaledKernel
from gpadjust.gp.feature_maps import features_of


def test_moments(data, build, kind, num_outputs, uniform):
    X, Y = data(num_outputs=num_outputs, n=12)
    model = build(kind, X, Y, input_transform=Normalize(2)).eval()
    Z = uniform(4, 2, high=2.0, seed=4)
    values = model.sample_functions(3000, seed=0)(Z)
    posterior = model.posterior(Z)
    assert values.shape == (3000, *posterior.mean.shape)
    for j in range(num_outputs):
        mean = posterior.mean[:, j].detach()
        covar = posterior.distribution.covariance_matrix
        covar = covar.reshape(4, num_outputs, 4, num_outputs)[:, j, :, j].detach()
        if num_outputs > 1 and not posterior.distribution._interleaved:
            full = posterior.distribution.covariance_matrix.reshape(num_outputs, 4, num_outputs, 4)
            covar = full[j, :, j].detach()
        sd = covar.diagonal().max().sqrt().item()
        draws = values[..., j].detach()
        torch.testing.assert_close(draws.mean(0), mean, rtol=0, atol=0.1 * sd)
        torch.testing.assert_close(draws.mT.cov(), covar, rtol=0, atol=0.15 * sd**2)


def test_paths_meet_exact_data(data, build, kind, num_outputs):
    if kind == "RRA-paper":
        pytest.skip("its weights do not meet the data")
    X, Y = data(num_outputs=num_outputs)
    options = {"low_X": X[:4] + 0.1, "low_Y": Y[:4]} if kind == "AR1" else {}
    model = build(kind, X, Y, 2e-5 * Y.square().mean(0).expand_as(Y), **options)
    values = model.sample_functions(5, seed=0)(X)
    torch.testing.assert_close(values, Y.expand_as(values), rtol=0, atol=0.1)


def test_shapes_and_seed(data, build, kind, num_outputs, uniform):
    model = build(kind, *data(num_outputs=num_outputs))
    functions, Z = model.sample_functions(3, seed=1), uniform(2, 6, 5, 2)
    values = functions(Z)
    assert values.shape == (3, 2, 6, 5, num_outputs)
    torch.testing.assert_close(functions(Z[1, 4]), values[:, 1, 4])
    assert functions(Z[:, :, :0]).shape == (3, 2, 6, 0, num_outputs)
    state = torch.get_rng_state()
    torch.testing.assert_close(model.sample_functions(3, seed=1)(Z), values)
    assert torch.equal(torch.get_rng_state(), state)


def test_a_batch_of_models(data, build, kind, num_outputs, uniform):
    model = build(kind, *data((3,), num_outputs=num_outputs))
    functions = model.sample_functions(2, seed=0)
    Z = uniform(4, 3, 5, 2)
    values = functions(Z)
    assert values.shape == (2, 4, 3, 5, num_outputs)
    torch.testing.assert_close(functions(Z[1]), values[:, 1])


def test_gradients(data, build, kind, num_outputs, uniform):
    functions = build(kind, *data(num_outputs=num_outputs)).sample_functions(2, seed=0)
    Z = uniform(3, 2, seed=3)
    assert torch.autograd.gradcheck(functions, Z.requires_grad_())


def test_a_later_fit_leaves_them(data, build, kind, shuffle, uniform):
    model, Z = build(kind, *data()), uniform(3, 2)
    functions = model.sample_functions(2, seed=0)
    before = functions(Z)
    shuffle(model.train())
    assert torch.equal(functions(Z), before)
    torch.testing.assert_close(copy.deepcopy(functions)(Z), before)


@pytest.mark.parametrize("number", [0, -1, 2.5])
def test_a_wrong_number(data, build, kind, number):
    with pytest.raises(ValueError, match="num_functions to be a whole number >= 1"):
        build(kind, *data()).sample_functions(number)


def test_botorch_draws_paths(data, build, kind, num_outputs, uniform):
    model = build(kind, *data(num_outputs=num_outputs)).eval()
    Z = uniform(5, 2)
    shape = (4, 5) if num_outputs == 1 else (4, num_outputs, 5)
    for draw in (draw_matheron_paths, draw_kernel_feature_paths):
        assert draw(model, torch.Size([4]))(Z).shape == shape
    assert MatheronPathModel(model, seed=0).posterior(Z).mean.shape == (5, num_outputs)


@pytest.mark.parametrize("outputs", [(), (2,)], ids=["1-output", "2-outputs"])
def test_features_make_the_kernel(uniform, outputs):
    shape = torch.Size(outputs)
    rbf = RBFKernel(batch_shape=shape).double()
    fourier = FourierKernel(FourierFeatures(8, 2), batch_shape=shape).double()
    constant = ConstantKernel(batch_shape=shape).double()
    constant.constant = torch.full((*shape, 1), 2.5, dtype=torch.float64)
    rho = PhysicsScaledKernel(InputsKernel(fourier + constant, 2), lambda X: 2 + X[..., 2])
    kernel = rho + InputsKernel(constant, 2) + InputsKernel(rbf, 2)
    x = uniform(6, 3)
    features = features_of(kernel, 3, 4096)(x)
    expected = kernel(x).to_dense().detach()
    actual = (features @ features.mT).detach()
    torch.testing.assert_close(actual, expected, rtol=0, atol=0.01 * expected.max().item())
