"""Functions drawn from the posterior, and BoTorch's pathwise sampling."""

import copy

import pytest
import torch
from botorch.models.deterministic import MatheronPathModel
from botorch.models.transforms import Normalize
from botorch.sampling.pathwise import draw_kernel_feature_paths, draw_matheron_paths
from gpytorch.kernels import ConstantKernel, RBFKernel, RFFKernel, ScaleKernel

from gpadjust import CKA
from gpadjust.gp import Term
from gpadjust.gp.features import TermFeatures
from tests.systems import line, refused


def test_moments(data, build, kind, num_outputs, uniform):
    X, Y = data(num_outputs=num_outputs, n=12)
    model = build(kind, X, Y, input_transform=Normalize(2)).eval()
    Z = uniform(4, 2, high=2.0, seed=4)
    with torch.no_grad():
        values, posterior = model.sample_functions(1500, seed=0)(Z), model.posterior(Z)
    assert values.shape == (1500, *posterior.mean.shape)
    covariance = posterior.distribution.covariance_matrix
    for j in range(num_outputs):
        alone = covariance[j::num_outputs, j::num_outputs]
        if num_outputs > 1 and not posterior.distribution._interleaved:
            alone = covariance[4 * j : 4 * (j + 1), 4 * j : 4 * (j + 1)]
        sd = alone.diagonal().max().sqrt().item()
        draws = values[..., j]
        torch.testing.assert_close(draws.mean(0), posterior.mean[:, j], rtol=0, atol=0.1 * sd)
        torch.testing.assert_close(draws.mT.cov(), alone, rtol=0, atol=0.15 * sd**2)


def test_paths_meet_exact_data(data, build, kind, num_outputs):
    X, Y = data(num_outputs=num_outputs)
    options = {"low_X": X[:4] + 0.1, "low_Y": Y[:4]} if kind == "AR1" else {}
    model = build(kind, X, Y, 2e-5 * Y.square().mean(0).expand_as(Y), **options)
    values = model.sample_functions(5, seed=0)(X)
    torch.testing.assert_close(values, Y.expand_as(values), rtol=0, atol=0.1)


class TestWithoutNoise:
    """The nugget of the covariance is noise to the posterior, and to functions drawn from it."""

    def spread(self, model, Z):
        """Of functions, in standard deviations of the posterior."""
        with torch.no_grad():
            values, (mean, variance) = model.sample_functions(500, 0, 8192)(Z), model.predict(Z)
        assert (variance.sqrt() < 2e-4).all()
        assert ((values.mean(0) - mean).abs() < 0.2 * variance.sqrt()).all()
        return values.std(0) / variance.sqrt()

    @pytest.fixture
    def model(self, uniform, num_outputs):
        X = line(8)
        Y = torch.cat([2 * (6 * X).sin() + X, (5 * X).cos()], -1)[:, :num_outputs]
        model = CKA(X, Y, physics=lambda X: (6 * X).sin().expand(-1, num_outputs))
        with torch.no_grad():
            model.likelihood.noise_covar.raw_noise.fill_(-25.0)
            for term in model.terms:
                term.kernel.base_kernel.raw_lengthscale.fill_(1.5)
                term.kernel.raw_outputscale.fill_(8.0)  # of which the nugget is a share
        return model.eval()

    Z = line(7, 0.05, 0.95)

    def test_spread(self, model):
        assert ((self.spread(model, self.Z) - 1).abs() < 0.1).all()

    @pytest.mark.slow
    def test_after_further_observations(self, model):
        more = self.Z[[1, 4]] + 0.03
        model = model.condition_on_observations(more, model.posterior(more).mean.detach())
        assert ((self.spread(model, self.Z) - 1).abs() < 0.2).all()


def test_wrong_numbers_and_points_for_other_functions(data, build, uniform):
    model = build("CKA", *data())
    for number, error in ((0, ValueError), (-1, ValueError), (2.5, TypeError)):
        refused(error, "num_functions must be", model.sample_functions, number)
        refused(error, "num_features must be", model.sample_functions, 1, num_features=number)
    refused(ValueError, "num_features to be even", model.sample_functions, 1, num_features=7)
    functions = model.sample_functions(3, seed=0)
    assert functions.each(uniform(3, 4, 2)).shape == (3, 4, 1)
    for shape in ((2, 4, 2), (4, 2), (1, 3, 4, 2)):
        refused(ValueError, r"3 functions, 3 x q x d", functions.each, uniform(*shape))


def test_shapes_seed_gradients_and_means(data, build, kind, num_outputs, uniform):
    model = build(kind, *data(num_outputs=num_outputs))
    functions, Z = model.sample_functions(3, seed=1), uniform(2, 6, 5, 2)
    values = functions(Z)
    assert values.shape == (3, 2, 6, 5, num_outputs)
    torch.testing.assert_close(functions(Z[1, 4]), values[:, 1, 4])
    assert functions(Z[:, :, :0]).shape == (3, 2, 6, 0, num_outputs)
    state = torch.get_rng_state()
    torch.testing.assert_close(model.sample_functions(3, seed=1)(Z), values)
    assert torch.equal(torch.get_rng_state(), state)
    functions = build(kind, *data(num_outputs=num_outputs)).sample_functions(2, seed=0)
    Z = uniform(3, 2, seed=3)
    assert torch.autograd.gradcheck(functions, Z.requires_grad_())
    model = build(kind, *data(num_outputs=num_outputs, n=9))
    functions, Z = model.mean_functions(), uniform(2, 5, 2)
    torch.testing.assert_close(functions(Z), model.predict(Z).mean.unsqueeze(0))
    Z.requires_grad_(True)
    (slope,) = torch.autograd.grad(functions(Z).sum(), Z)
    (expected,) = torch.autograd.grad(model.predict(Z).mean.sum(), Z)
    torch.testing.assert_close(slope, expected)


def test_seeds_and_later_fits(data, build, monkeypatch, kind, shuffle, uniform):
    seeds, model = [], build("CKA", *data())
    monkeypatch.setattr(torch.cuda, "manual_seed_all", seeds.append)
    model.sample_functions(3, seed=1)
    assert seeds == []
    model, Z = build(kind, *data()), uniform(3, 2)
    functions = model.sample_functions(2, seed=0)
    before = functions(Z)
    shuffle(model.train())
    assert torch.equal(functions(Z), before)
    torch.testing.assert_close(copy.deepcopy(functions)(Z), before)


@pytest.mark.slow
def test_botorch_draws_paths(data, build, kind, num_outputs, uniform):
    model = build(kind, *data(num_outputs=num_outputs)).eval()
    Z = uniform(5, 2)
    shape = (4, 5) if num_outputs == 1 else (4, num_outputs, 5)
    for draw in (draw_matheron_paths, draw_kernel_feature_paths):
        assert draw(model, torch.Size([4]))(Z).shape == shape
    values = draw_matheron_paths(model, torch.Size([512]))(Z).detach()
    posterior = model.posterior(Z)
    error = values.mean(0).reshape(num_outputs, 5).mT - posterior.mean
    assert (error.abs() < 0.25 * posterior.variance.sqrt()).all()
    assert MatheronPathModel(model, seed=0).posterior(Z).mean.shape == (5, num_outputs)


@pytest.mark.parametrize("outputs", [(), (2,)], ids=["1-output", "2-outputs"])
def test_features_make_the_kernel(uniform, outputs):
    shape = torch.Size(outputs)
    constant = ConstantKernel(batch_shape=shape).double()
    constant.constant = torch.full((*shape, 1), 2.5, dtype=torch.float64)
    rff = RFFKernel(num_samples=4, num_dims=2, batch_shape=shape).double()
    rbf, mean = RBFKernel(batch_shape=shape), torch.zeros(*shape, 1, dtype=torch.float64)
    x = uniform(6, 3)
    for kernel, tolerance in ((ScaleKernel(rff) + constant, 1e-12), (rbf + constant, 0.01)):
        term = Term("f", kernel.double(), 2, None, mean, mean + 0.7)
        features = TermFeatures(term, 4096)(x)
        expected = term.covariance(x, x).detach()
        close = {"rtol": 0, "atol": tolerance * expected.max().item()}
        torch.testing.assert_close((features @ features.mT).detach(), expected, **close)


def test_a_mean_for_each_sample_of_the_hyperparameters(data, held, uniform):
    model, singles = held("CKA", *data(n=9))
    Z = uniform(5, 2, seed=3)
    each = [single.predict(Z).mean for single in singles]
    torch.testing.assert_close(model.mean_functions()(Z), torch.stack(each))
