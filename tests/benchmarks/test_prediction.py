"""Time of predicting and of conditioning beside the ways around them; `--benchmark-only`."""

import pytest
import torch
from botorch.models import SingleTaskGP

from gpadjust import CKA

NUM_INPUTS = 6


@pytest.fixture(autouse=True)
def _without_gradients():
    with torch.no_grad():
        yield


@pytest.fixture(params=[1, 4], ids=["1-output", "4-outputs"])
def m(request):
    return request.param


@pytest.fixture
def data(m, uniform):
    """500 points, one more, and 200 to predict at."""

    def truth(X):
        return 1.3 * crude(X)[..., :m] + X[..., :m].square()

    X, Z = uniform(501, NUM_INPUTS), uniform(200, NUM_INPUTS, seed=1)
    Y = truth(X) + 0.01 * torch.randn(501, m, dtype=torch.float64)
    return X, Y, Z


def crude(X):
    return (3 * X[..., :4]).sin() + X[..., 1:5]


def build(X, Y):
    return CKA(X, Y, physics=lambda X: crude(X)[..., : Y.shape[-1]]).eval()


def moments(posterior):
    return posterior.mean, posterior.variance


@pytest.mark.parametrize("other", ["posterior(Z[:, None])", "posterior(Z)", "SingleTaskGP"])
def test_predict(benchmark, record_ratio, data, m, other):
    X, Y, Z = data
    model, stock = build(X[:500], Y[:500]), SingleTaskGP(X[:500], Y[:500])
    slow = {
        "posterior(Z[:, None])": lambda: moments(model.posterior(Z.unsqueeze(-2))),
        "posterior(Z)": lambda: moments(model.posterior(Z)),
        "SingleTaskGP": lambda: moments(stock.posterior(Z.unsqueeze(-2))),
    }
    benchmark.group = f"predict at 200 points, n = 500, {m} outputs"
    record_ratio(f"time of {other} / predict", slow[other], lambda: model.predict(Z))


@pytest.mark.parametrize("n", [20, 100, 500])
def test_predict_beside_its_products(benchmark, record_ratio, uniform, n):
    """Of 200 points, each time new ones: at most 1.6 times the two products at n = 500."""
    X = uniform(n, NUM_INPUTS)
    model = build(X, 1.3 * crude(X) + X[:, :4].square())
    model.predict(X)
    factors, covariance = model.strategy().factors(), torch.rand(4, 200, n, dtype=torch.float64)

    def products():
        return covariance @ factors.base.mT, covariance @ factors.alpha.unsqueeze(-1)

    def predict():
        return model.predict(torch.rand(200, NUM_INPUTS, dtype=torch.float64))

    benchmark.group = f"predict at 200 points, n = {n}, 4 outputs"
    record_ratio("predict / two products", predict, products)


def test_append(benchmark, record_ratio, data, m):
    X, Y, Z = data
    model, whole = build(X[:500], Y[:500]), build(X, Y)
    model.predict(Z)

    def refactorise():
        whole.prediction_strategy = None
        return whole.strategy().factors()

    benchmark.group = f"factors with one more point, n = 500, {m} outputs"
    record_ratio(
        "time of refactorising / conditioning",
        refactorise,
        lambda: model.condition_on_observations(X[500:], Y[500:]),
    )


@pytest.mark.parametrize("other", ["rebuild", "SingleTaskGP"])
def test_condition(benchmark, record_ratio, data, m, other):
    X, Y, Z = data
    model, stock = build(X[:500], Y[:500]), SingleTaskGP(X[:500], Y[:500])
    stock.posterior(Z)
    state, z = model.state_dict(), Z[:1]

    def rebuild():
        new = build(X, Y)
        new.load_state_dict(state)
        return moments(new.posterior(z))

    slow = {
        "rebuild": rebuild,
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
