"""BoTorch's acquisition functions on a fully Bayesian model."""

import pytest
import torch
from botorch.acquisition import (
    LogExpectedImprovement,
    qLogExpectedImprovement,
    qLogNoisyExpectedImprovement,
    qNegIntegratedPosteriorVariance,
)
from botorch.acquisition.bayesian_active_learning import qBayesianActiveLearningByDisagreement
from botorch.acquisition.monte_carlo import qPosteriorStandardDeviation
from botorch.acquisition.objective import LinearMCObjective
from botorch.optim import optimize_acqf
from botorch.sampling import SobolQMCNormalSampler

SAMPLER = {"sampler": SobolQMCNormalSampler(torch.Size([8]), seed=0)}
ACQUISITIONS = {
    "qLogNEI": lambda model, X: qLogNoisyExpectedImprovement(model, X, **SAMPLER),
    "qLogEI": lambda model, X: qLogExpectedImprovement(model, 1.0, **SAMPLER),
    "LogEI": lambda model, X: LogExpectedImprovement(model, best_f=1.0),
    "NIPV": lambda model, X: qNegIntegratedPosteriorVariance(model, mc_points=X),
    "PSTD": lambda model, X: qPosteriorStandardDeviation(model, **SAMPLER),
    "BALD": lambda model, X: qBayesianActiveLearningByDisagreement(model, **SAMPLER),
}
BOUNDS = torch.tensor([[0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)


@pytest.mark.parametrize("name", ACQUISITIONS)
@pytest.mark.parametrize("kind", ["CKA", "AR1"])
def test_optimize(held, data, name, kind):
    X, Y = data()
    model, _ = held(kind, X, Y)
    acquisition = ACQUISITIONS[name](model, X)
    q = 2 if name.startswith("q") or name == "PSTD" else 1
    point, value = optimize_acqf(
        acquisition, BOUNDS, q=q, num_restarts=2, raw_samples=4, options={"maxiter": 3}
    )
    assert point.shape == (q, 2)
    assert value.isfinite().all()
    assert acquisition(torch.rand(5, q, 2, dtype=torch.float64)).shape == (5,)


@pytest.mark.parametrize("name", ["qLogNEI", "LogEI", "NIPV", "PSTD"])
def test_gradients_through_the_physics(held, data, uniform, gradient_is_right, name):
    X, Y = data()
    model, _ = held("CKA", X, Y)
    gradient_is_right(ACQUISITIONS[name](model, X), uniform(1, 1, 2, high=2.0, seed=5))


def test_values_are_averages_over_the_samples(held, data, uniform):
    X, Y = data()
    model, singles = held("CKA", X, Y)
    Z, best = uniform(6, 1, 2, high=2.0), Y.mean()
    each = torch.stack([LogExpectedImprovement(single, best_f=best)(Z) for single in singles])
    actual = LogExpectedImprovement(model, best_f=best)(Z)
    torch.testing.assert_close(actual, each.exp().mean(0).log())
    each = [qNegIntegratedPosteriorVariance(single, mc_points=X)(Z) for single in singles]
    actual = qNegIntegratedPosteriorVariance(model, mc_points=X)(Z)
    torch.testing.assert_close(actual, torch.stack(each).mean(0))


@pytest.mark.filterwarnings("ignore:Sparse invariant checks:UserWarning")
@pytest.mark.filterwarnings("ignore:A not p.d.")
def test_two_outputs(held, data, uniform):
    X, Y = data(num_outputs=2)
    model, _ = held("CKA", X, Y)
    Z = uniform(6, 1, 2, high=2.0)
    weights = torch.tensor([1.0, -0.5], dtype=torch.float64)
    objective = LinearMCObjective(weights)
    values = qLogNoisyExpectedImprovement(model, X, objective=objective, **SAMPLER)(Z)
    assert values.shape == (6,)
