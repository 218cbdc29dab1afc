"""Time of a likelihood step and of fits beside others; run with `--benchmark-only`."""

import contextlib
import io
import warnings
from functools import partial

import pytest
import torch
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.optim.closures import get_loss_closure_with_grads
from gpytorch.mlls import ExactMarginalLogLikelihood

from gpadjust import CKA, fit


def low(X):
    return (3 * X[..., :1]).sin() + X[..., 1:2]


def high(X):
    return (1 + 0.3 * X[..., :1]) * low(X) + X[..., 1:2].square()


def of_botorch(X, Y):
    model = SingleTaskGP(X, Y)
    return ExactMarginalLogLikelihood(model.likelihood, model)


def data(uniform, n):
    X = uniform(n, 2)
    return X, high(X) + 0.01 * torch.randn(n, 1, dtype=torch.float64)


@pytest.mark.parametrize("n", [50, 500])
def test_step(benchmark, record_ratio, uniform, n):
    X, Y = data(uniform, n)
    model = CKA(X, Y, physics=low, nested=False)
    u = 0.1 * torch.randn(1, *model.u.shape[1:], dtype=torch.float64)
    mll = of_botorch(X, Y)
    theirs = get_loss_closure_with_grads(mll, dict(mll.model.named_parameters()))
    benchmark.group = f"likelihood and gradient, n = {n}"
    ours = partial(model.log_likelihood, u)
    record_ratio("our step / BoTorch's of a SingleTaskGP", ours, theirs, 15)


@pytest.mark.parametrize("method", ["map", "bayes"])
@pytest.mark.parametrize("n", [12, 50, 200, 500])
def test_fit(benchmark, record_ratio, uniform, n, method):
    X, Y = data(uniform, n)

    benchmark.group = f"fit beside fit_gpytorch_mll, n = {n}"
    record_ratio(
        f"fit(CKA, {method!r}) / BoTorch's of a SingleTaskGP",
        lambda: fit(CKA(X, Y, physics=low), method),
        lambda: fit_gpytorch_mll(of_botorch(X, Y)),
        3,
    )


@pytest.mark.parametrize("n", [8, 50, 200])
def test_fit_beside_mfk(benchmark, record_ratio, uniform, n):
    mfk = pytest.importorskip("smt.applications").MFK
    X_low, noise = uniform(2 * n, 2), 0.01 * torch.randn(n, 1, dtype=torch.float64)
    X = X_low[:n]

    def theirs():
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = mfk(theta0=[1.0] * 2, print_global=False)
            model.set_training_values(X_low.numpy(), low(X_low).numpy(), name=0)
            model.set_training_values(X.numpy(), (high(X) + noise).numpy())
            model.train()

    benchmark.group = f"fit, n = {n}"
    ours = CKA(X, high(X) + noise, physics=low)
    rounds = 3 if n < 50 else 1
    record_ratio("fit(CKA, 'map') / SMT's MFK", lambda: fit(ours, "map"), theirs, rounds)
