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


def build_cka(data):
    return CKA(*data, physics=crude)


def fit_by_botorch(model):
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))


def predict(model, Z):
    with torch.no_grad():
        posterior = model.posterior(Z)
        return posterior.mean, posterior.variance


FITS = {
    "CKA by fit": (build_cka, fit),
    "CKA by fit_gpytorch_mll": (build_cka, fit_by_botorch),
    "SingleTaskGP by fit_gpytorch_mll": (lambda data: SingleTaskGP(*data), fit_by_botorch),
}


@pytest.mark.parametrize("name", list(FITS))
def test_fit(benchmark, data, name):
    build, fit_model = FITS[name]
    benchmark.group = f"fit, n = {len(data[0])}"
    benchmark.pedantic(fit_model, setup=lambda: ((build(data),), {}), **ROUNDS)


@pytest.mark.parametrize("name", ["CKA", "SingleTaskGP"])
def test_posterior(benchmark, data, uniform, name):
    model = build_cka(data) if name == "CKA" else SingleTaskGP(*data)
    Z = uniform(200, 2, seed=1)
    benchmark.group = f"posterior at 200 points, n = {len(data[0])}"
    benchmark(predict, model, Z)


@pytest.mark.parametrize("name", ["fit", "fit_gpytorch_mll", "posterior"])
def test_ratio_to_single_task_gp(benchmark, record_ratio, data, uniform, name):
    benchmark.group = f"ratio of {name}, n = {len(data[0])}"
    if name == "posterior":
        Z = uniform(200, 2, seed=1)
        ours, theirs = build_cka(data), SingleTaskGP(*data)
        actions = (lambda: predict(ours, Z)), (lambda: predict(theirs, Z))
        rounds = 50
    else:
        our_fit = fit if name == "fit" else fit_by_botorch
        actions = (
            lambda: our_fit(build_cka(data)),
            lambda: fit_by_botorch(SingleTaskGP(*data)),
        )
        rounds = 3
    for action in actions:
        action()
    record_ratio("ratio to SingleTaskGP", *actions, rounds)
