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
from botorch.models.transforms import Normalize
from botorch.optim import optimize_acqf
from botorch.sampling import SobolQMCNormalSampler

from gpadjust import CKA, BlackBoxPhysics

BOUNDS = torch.tensor([[0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)
QUICK = {"num_restarts": 2, "raw_samples": 8, "options": {"maxiter": 5, "batch_limit": 2}}


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
CASES = [*((name, "CKA") for name in NAMES), ("deviation", "AR1"), ("knowledge gradient", "RRA")]
some = pytest.mark.parametrize(("name", "kind"), CASES)


@some
def test_gradients_through_the_physics(data, build, uniform, gradient_is_right, name, kind):
    X, Y = data()
    model = build(kind, X, Y).eval()
    function, q = acquisition_function(name, model, X, uniform(30, 2, high=2.0))
    gradient_is_right(function, uniform(1, q, 2, high=2.0, seed=5))


def optimize(acquisition, uniform, q, **options):
    """The optimiser stays within the bounds, and beats most random points."""
    candidates, value = optimize_acqf(acquisition, BOUNDS, q=q, **{**QUICK, **options})
    assert candidates.shape == (q, 2)
    assert ((candidates >= BOUNDS[0]) & (candidates <= BOUNDS[1])).all()
    if not isinstance(acquisition, qKnowledgeGradient):
        others = acquisition(uniform(16, q, 2, high=2.0, seed=9))
        assert value >= others.median()
    assert value.isfinite()


@some
def test_optimize(data, build, uniform, name, kind):
    X, Y = data()
    model = build(kind, X, Y, input_transform=Normalize(2)).eval()
    acquisition, q = acquisition_function(name, model, X, uniform(30, 2, high=2.0))
    optimize(acquisition, uniform, 1 if q == 5 else q)


@pytest.mark.filterwarnings("ignore:No gradient flows:UserWarning")
def test_a_black_box_without_gradient(data, uniform):
    X, Y = data()
    physics = BlackBoxPhysics(lambda X: 2 + X.sum(-1), gradient=None)
    model = CKA(X, Y, physics=physics).eval()
    acquisition = qNegIntegratedPosteriorVariance(model, mc_points=uniform(30, 2, high=2.0))
    optimize(acquisition, uniform, 1, options={"with_grad": False, "maxiter": 5})
