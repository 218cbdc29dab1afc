"""Time of predicting and of conditioning beside a SingleTaskGP; run with `--benchmark-only`."""

import pytest
import torch
from botorch.models import SingleTaskGP

from gpadjust import CKA

NUM_INPUTS = 6


@pytest.fixture(autouse=True)
def _without_gradients():
    with torch.no_grad():
        yield


outputs = pytest.mark.parametrize("m", [1, 4])


@pytest.fixture
def data(m, uniform):
    """500 points, one more, and 200 to predict at; models of the 500."""
    X, Z = uniform(501, NUM_INPUTS), uniform(200, NUM_INPUTS, seed=1)
    Y = 1.3 * crude(X)[..., :m] + X[..., :m].square()
    Y = Y + 0.01 * torch.randn(501, m, dtype=torch.float64)
    return X, Y, Z, build(X[:500], Y[:500]), SingleTaskGP(X[:500], Y[:500])


def crude(X):
    return (3 * X[..., :4]).sin() + X[..., 1:5]


def build(X, Y):
    return CKA(X, Y, physics=lambda X: crude(X)[..., : Y.shape[-1]]).eval()


def moments(posterior):
    return posterior.mean, posterior.variance


@outputs
@pytest.mark.parametrize("other", ["posterior(Z)", "SingleTaskGP"])
def test_predict(benchmark, record_ratio, data, m, other):
    *_, Z, model, stock = data
    slow = {
        "posterior(Z)": lambda: moments(model.posterior(Z)),
        "SingleTaskGP": lambda: moments(stock.posterior(Z.unsqueeze(-2))),
    }
    benchmark.group = f"predict at 200 points, n = 500, {m} outputs"
    record_ratio(f"time of {other} / predict", slow[other], lambda: model.predict(Z))


@outputs
@pytest.mark.parametrize("other", ["rebuild", "SingleTaskGP"])
def test_condition(benchmark, record_ratio, data, m, other):
    X, Y, Z, model, stock = data
    stock.posterior(Z)
    z = Z[:1]
    model.predict(z)
    slow = {
        "rebuild": lambda: build(X, Y).predict(z),
        "SingleTaskGP": lambda: moments(
            stock.condition_on_observations(X[500:], Y[500:]).posterior(z)
        ),
    }
    benchmark.group = f"condition on one point and predict, n = 500, {m} outputs"
    record_ratio(
        f"time of {other} / conditioning",
        slow[other],
        lambda: model.condition_on_observations(X[500:], Y[500:]).predict(z),
    )
