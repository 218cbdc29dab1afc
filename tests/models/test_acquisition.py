"""The models inside BoTorch's acquisition functions."""

import pytest
import torch
from botorch.acquisition import (
    PosteriorStandardDeviation,
    qKnowledgeGradient,
    qLogNoisyExpectedImprovement,
    qNegIntegratedPosteriorVariance,
)
from botorch.acquisition.monte_carlo import qPosteriorStandardDeviation
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.models.transforms import Normalize
from botorch.optim import optimize_acqf
from botorch.sampling import SobolQMCNormalSampler

from gpadjust import CKA, BlackBoxPhysics

BOUNDS = torch.tensor([[0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)
QUICK = {"num_restarts": 2, "raw_samples": 8, "options": {"maxiter": 5, "batch_limit": 2}}


@pytest.fixture
def model(data, build, costly_kind):
    return build(costly_kind, *data(), input_transform=Normalize(2)).eval()


def inside(candidates, q=1):
    assert candidates.shape == (q, 2)
    assert (candidates >= BOUNDS[0]).all()
    assert (candidates <= BOUNDS[1]).all()


def best_of(acquisition, value, uniform, q=1):
    """The optimiser's value is at least that of most random points."""
    others = acquisition(uniform(16, q, 2, high=2.0, seed=9))
    assert value >= others.median()


@pytest.mark.slow
def test_integrated_posterior_variance(model, uniform):
    acquisition = qNegIntegratedPosteriorVariance(model, mc_points=uniform(30, 2, high=2.0))
    candidates, value = optimize_acqf(acquisition, BOUNDS, q=2, **QUICK)
    inside(candidates, q=2)
    best_of(acquisition, value, uniform, q=2)


def test_one_point_of_cka(data, build, uniform):
    model = build("CKA", *data()).eval()
    acquisition = qNegIntegratedPosteriorVariance(model, mc_points=uniform(30, 2, high=2.0))
    options = {"num_restarts": 1, "raw_samples": 8, "options": {"maxiter": 3}}
    candidates, value = optimize_acqf(acquisition, BOUNDS, q=1, **options)
    inside(candidates)
    best_of(acquisition, value, uniform)


def acquisition_function(name, model, baseline, points):
    """An acquisition function, and the number of points that it takes."""
    sampler = SobolQMCNormalSampler(torch.Size([16]), seed=0)
    if name == "variance":
        return qNegIntegratedPosteriorVariance(model, mc_points=points), 2
    if name == "deviation":
        return qPosteriorStandardDeviation(model, sampler=sampler), 2
    if name == "noisy improvement":
        return qLogNoisyExpectedImprovement(model, baseline, sampler=sampler), 2
    if name == "one deviation":
        return PosteriorStandardDeviation(model), 1
    return qKnowledgeGradient(model, num_fantasies=4), 5


NAMES = ["variance", "deviation", "noisy improvement", "one deviation", "knowledge gradient"]


def gradient_is_right(function, X):
    leaf = X.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf).sum(), leaf)
    differences = torch.zeros_like(X)
    for i in range(X.numel()):
        step = torch.zeros_like(X)
        step.view(-1)[i] = 1e-5
        change = function(X + step) - function(X - step)
        differences.view(-1)[i] = change.item() / 2e-5
    size = differences.abs().max().item()
    assert size > 0
    torch.testing.assert_close(gradient, differences, rtol=1e-4, atol=1e-4 * size)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_through_the_physics(data, build, costly_kind, uniform, name):
    X, Y = data()
    model = build(costly_kind, X, Y).eval()
    function, q = acquisition_function(name, model, X, uniform(30, 2, high=2.0))
    Z = uniform(1, q, 2, high=2.0, seed=5)
    assert function(Z).isfinite().all()
    gradient_is_right(function, Z)


@pytest.mark.parametrize("name", ["variance", "deviation", "noisy improvement"])
def test_gradients_of_a_black_box_by_differences(data, uniform, crude_physics, name):
    X, Y = data()
    physics = BlackBoxPhysics(lambda X: crude_physics(torch.from_numpy(X))[:, :1].numpy())
    model = CKA(X, Y, physics=physics).eval()
    function, q = acquisition_function(name, model, X, uniform(30, 2, high=2.0))
    gradient_is_right(function, uniform(1, q, 2, high=2.0, seed=5))


def test_posterior_standard_deviation(model, uniform):
    acquisition = acquisition_function("deviation", model, None, None)[0]
    candidates, value = optimize_acqf(acquisition, BOUNDS, q=2, **QUICK)
    inside(candidates, q=2)
    best_of(acquisition, value, uniform, q=2)


def test_noisy_expected_improvement(model, data, uniform):
    sampler = SobolQMCNormalSampler(torch.Size([16]), seed=0)
    acquisition = qLogNoisyExpectedImprovement(model, data()[0], sampler=sampler)
    candidates, value = optimize_acqf(acquisition, BOUNDS, q=1, **QUICK)
    inside(candidates)
    best_of(acquisition, value, uniform)


def test_knowledge_gradient(model):
    acquisition = qKnowledgeGradient(model, num_fantasies=4)
    candidates, value = optimize_acqf(acquisition, BOUNDS, q=1, **QUICK)
    inside(candidates)
    assert value.isfinite()


@pytest.mark.slow
def test_several_outputs(data, build, costly_kind, uniform):
    model = build(costly_kind, *data(num_outputs=2)).eval()
    weigh = ScalarizedPosteriorTransform(torch.tensor([0.5, 0.5], dtype=torch.float64))
    acquisition = qNegIntegratedPosteriorVariance(
        model, mc_points=uniform(30, 2, high=2.0), posterior_transform=weigh
    )
    candidates, value = optimize_acqf(acquisition, BOUNDS, q=1, **QUICK)
    inside(candidates)
    best_of(acquisition, value, uniform)


@pytest.mark.filterwarnings("ignore:No gradient flows:UserWarning")
def test_a_black_box_without_gradient(data, uniform):
    X, Y = data()
    physics = BlackBoxPhysics(lambda X: 2 + X.sum(-1), gradient=None)
    model = CKA(X, Y, physics=physics).eval()
    acquisition = qNegIntegratedPosteriorVariance(model, mc_points=uniform(30, 2, high=2.0))
    options = {"num_restarts": 2, "raw_samples": 8, "options": {"with_grad": False, "maxiter": 5}}
    candidates, value = optimize_acqf(acquisition, BOUNDS, q=1, **options)
    inside(candidates)
    best_of(acquisition, value, uniform)


def test_a_black_box_with_finite_differences(data, uniform, crude_physics):
    physics = BlackBoxPhysics(lambda X: crude_physics(torch.from_numpy(X))[:, :1].numpy())
    model = CKA(*data(), physics=physics).eval()
    acquisition = qNegIntegratedPosteriorVariance(model, mc_points=uniform(30, 2, high=2.0))
    candidates, value = optimize_acqf(acquisition, BOUNDS, q=1, **QUICK)
    inside(candidates)
    best_of(acquisition, value, uniform)
