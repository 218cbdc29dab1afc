"""Time of CKA beside BoTorch's SingleTaskGP; run with `--benchmark-only`."""

import pytest
import torch
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from gpytorch.mlls import ExactMarginalLogLikelihood

from gpadjust import CKA, fit

ROUNDS = {"rounds": 3, "warmup_rounds": 1}


def crude(X):
    return (3 * X[..., :1]).sin() + X[..., 1:]


@pytest.fixture(params=[20, 100], ids=["n=20", "n=100"])
def data(request, uniform):
    X = uniform(request.param, 2)
    noise = 0.01 * torch.randn(request.param, 1, dtype=torch.float64)
    return X, (1 + 0.3 * X[:, :1]) * crude(X) + X[:, 1:].square() + noise


def several(X, m):
    columns = [crude(X)[:, 0], X.prod(-1), X.sum(-1), (4 * X[:, 1]).cos()]
    return torch.stack(columns[:m], dim=-1)


def build_cka(data):
    return CKA(*data, physics=crude)


def fit_by_botorch(model):
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))


def predict(model, Z):
    with torch.no_grad():
        posterior = model.posterior(Z)
        return posterior.mean, posterior.variance


@pytest.mark.parametrize(("n", "m"), [(50, 1), (200, 1), (500, 1), (1000, 1), (2000, 1), (500, 4)])
def test_fit(benchmark, record_ratio, uniform, n, m):
    """At most 2.0 for n from 200 on, without loss: see tests/inference."""
    X = uniform(n, 2)
    noise = 0.01 * torch.randn(n, m, dtype=torch.float64)
    Y = (1 + 0.3 * X[:, :1]) * several(X, m) + X[:, 1:].square() + noise

    def ours():
        fit(CKA(X, Y, physics=lambda X: several(X, m)), "map")

    def theirs():
        fit_by_botorch(SingleTaskGP(X, Y))

    benchmark.group = f"fit beside fit_gpytorch_mll, n = {n}, {m} output(s)"
    record_ratio("fit of CKA / BoTorch's of a SingleTaskGP", ours, theirs, 3 if n < 1000 else 1)


def test_ratio_of_posterior(benchmark, record_ratio, data, uniform):
    Z = uniform(200, 2, seed=1)
    ours, theirs = build_cka(data), SingleTaskGP(*data)
    actions = (lambda: predict(ours, Z)), (lambda: predict(theirs, Z))
    for action in actions:
        action()
    benchmark.group = f"ratio of posterior, n = {len(data[0])}"
    record_ratio("ratio to SingleTaskGP", *actions, 50)
