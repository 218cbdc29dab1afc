"""Marginal predictions at many points, and how long what they are made from is kept."""

import copy
import pickle

import pytest
import torch
from botorch.models.transforms import Normalize, Standardize
from gpytorch.kernels import InducingPointKernel, RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.settings import detach_test_caches

from gpadjust import BlackBoxPhysics, ZeroMeanGP, fit
from tests.systems import crude


def reference(model, Z, **options):
    posterior = model.posterior(Z.unsqueeze(-2), **options)
    return posterior.mean.squeeze(-2), posterior.variance.squeeze(-2)


def same(model, Z, close, **options):
    for actual, expected in zip(
        model.predict(Z, **options), reference(model, Z, **options), strict=True
    ):
        close(actual, expected)


@pytest.mark.parametrize("noise", [False, True], ids=["function", "observations"])
@pytest.mark.parametrize("setting", ["plain", "known-noise", "transformed"])
def test_as_the_posterior(data, build, kind, num_outputs, shuffle, uniform, close, setting, noise):
    X, Y = data(num_outputs=num_outputs)
    options = {}
    if setting == "transformed":
        options["input_transform"] = Normalize(2)
        options["outcome_transform"] = Standardize(num_outputs)
    Yvar = uniform(*Y.shape, low=0.01, high=0.1) if setting == "known-noise" else None
    model = shuffle(build(kind, X, Y, Yvar, **options))
    same(model, uniform(7, 2, high=2.0, seed=1), close, observation_noise=noise)
    same(model, uniform(3, 7, 2, high=2.0, seed=1), close, observation_noise=noise)


def test_a_batch_of_models_and_no_points(data, build, kind, num_outputs, uniform, close):
    model = build(kind, *data((3,), num_outputs=num_outputs)).eval()
    for shape in [(7, 2), (3, 7, 2), (4, 3, 7, 2)]:
        Z = uniform(*shape, high=2.0, seed=1)
        prediction, posterior = model.predict(Z), model.posterior(Z)
        close(prediction.mean, posterior.mean)
        close(prediction.variance, posterior.variance)
    model = build(kind, *data(num_outputs=num_outputs))
    mean, variance = model.predict(torch.empty(0, 2, dtype=torch.float64))
    assert mean.shape == variance.shape == (0, num_outputs)


def test_gradients_to_the_hyperparameters(data, build, kind, num_outputs, uniform):
    model, Z = build(kind, *data(num_outputs=num_outputs)).eval(), uniform(3, 2)
    learnt = [p for p in model.parameters() if p.requires_grad]

    def predict(*values):
        model.prediction_strategy = None
        return torch.cat(model.predict(Z))

    with detach_test_caches(False):
        assert torch.autograd.gradcheck(predict, learnt, atol=1e-4)
    model.predict(Z)
    with detach_test_caches(False):  # after a prediction whose factors had no graph
        found = torch.autograd.grad(model.predict(Z).mean.sum(), learnt)
        model.prediction_strategy = None
        expected = torch.autograd.grad(model.predict(Z).mean.sum(), learnt)
    torch.testing.assert_close(found, expected)
    # What is remembered has no graph that one backward pass would free.
    for _ in range(2):
        model.predict(Z.requires_grad_()).mean.sum().backward()


@pytest.mark.slow
@pytest.mark.parametrize("change", ["training", "fit", "state", "data"])
def test_nothing_stale_is_kept(data, build, kind, uniform, close, shuffle, change):
    X, Y = data()
    model = build(kind, X, Y + 0.1 * uniform(*Y.shape, seed=5))
    Z = uniform(5, 2, high=2.0)
    before = model.predict(Z)
    if change == "training":
        shuffle(model.train())
    elif change == "fit":
        fit(model, "map")
    elif change == "state":
        model.load_state_dict(shuffle(build(kind, *data(seed=3))).state_dict())
    else:
        inputs, targets = model.eval().train_inputs[0], model.train_targets
        model.set_train_data(inputs, 2 * targets, strict=False)
    after = model.predict(Z)
    assert (after.mean - before.mean).abs().max() > 1e-6
    fresh = copy.deepcopy(model)
    assert fresh.prediction_strategy is None
    # A fit may leave variances that are little more than rounding errors.
    tolerance = 1e-2 if change == "fit" else 1e-8
    for actual, expected in zip(after, reference(fresh, Z), strict=True):
        close(actual, expected, tolerance)


def test_pickles_and_kernels_with_their_own_way(data, uniform, close):
    model, Z = ZeroMeanGP(*data(n=148)), uniform(5, 2)
    model = model.condition_on_observations(Z[:2] + 1, torch.ones(2, 1).double())
    size = len(pickle.dumps(ZeroMeanGP(*data(n=150))))
    before = model.predict(Z).mean
    assert len(pickle.dumps(model)) < size + 10_000
    for again in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
        torch.testing.assert_close(again.predict(Z).mean, before)
    X, Y = data(n=20)
    likelihood = GaussianLikelihood().double()
    kernel = InducingPointKernel(ScaleKernel(RBFKernel()).double(), X[:8].clone(), likelihood)
    model = ZeroMeanGP(X, Y, covar_module=kernel, likelihood=likelihood).eval()
    same(model, uniform(5, 2), close)


# Gradients of predictions in X


@pytest.mark.parametrize("black_box", [False, True], ids=["torch", "numpy"])
def test_gradients_to_the_inputs(data, build, kind, num_outputs, uniform, black_box):
    X, Y = data(num_outputs=num_outputs)
    options = {"input_transform": Normalize(2)} if black_box else {}
    if black_box and kind != "ZeroMeanGP":
        options["physics"] = BlackBoxPhysics(
            lambda X: crude(torch.from_numpy(X))[:, :num_outputs].numpy()
        )
    model = build(kind, X, Y, **options).eval().requires_grad_(False)
    Z = uniform(3, 2, high=2.0, seed=3).requires_grad_()

    def moments(Z):
        posterior = model.posterior(Z)
        return posterior.mean, posterior.variance

    assert torch.autograd.gradcheck(moments, Z, rtol=1e-4)
    assert torch.autograd.gradcheck(model.predict, Z, rtol=1e-4)


def test_gradients_of_terms(data, build, kind, uniform):
    model = build(kind, *data(num_outputs=2)).eval().requires_grad_(False)
    Z = uniform(3, 2, high=2.0, seed=3).requires_grad_()
    for name in model.term_names:

        def moments(Z, name=name):
            posterior = model.term(name, Z)
            return posterior.mean, posterior.variance

        assert torch.autograd.gradcheck(moments, Z)
