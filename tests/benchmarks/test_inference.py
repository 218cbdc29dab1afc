"""Time of a likelihood step, a fit and full Bayes beside others; run with `--benchmark-only`."""

import contextlib
import io
import warnings

import pytest
import torch
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from botorch.optim.closures import get_loss_closure_with_grads
from gpadjust.inference.targets import LogLikelihood
from gpytorch.mlls import ExactMarginalLogLikelihood

from gpadjust import CKA, fit


def crude(X):
    return torch.stack(
        [(3 * X[:, 0]).sin() + X[:, 1], X[:, 2] * X[:, 3], X.sum(-1), (4 * X[:, 4]).cos()], -1
    )


@pytest.mark.parametrize("other", ["BoTorch's step", "Cholesky and inverse"])
def test_step(benchmark, record_ratio, uniform, other):
    X = uniform(500, 6)
    Y = (1 + 0.3 * X[:, :1]) * crude(X) + X[:, :4].square()
    model = CKA(X, Y + 0.01 * torch.randn(500, 4, dtype=torch.float64), physics=crude)
    objective = LogLikelihood(model)
    point = objective.parameters.current()
    with torch.no_grad():
        _, covariance, *_ = objective.distribution(objective.parameters.unflatten(point))
    mll = ExactMarginalLogLikelihood(model.likelihood, model)
    step = get_loss_closure_with_grads(
        mll, {name: p for name, p in mll.named_parameters() if p.requires_grad}
    )
    others = {
        "BoTorch's step": step,
        "Cholesky and inverse": lambda: torch.cholesky_inverse(torch.linalg.cholesky(covariance)),
    }

    def ours():
        return objective.value_and_gradient(point)

    ours(), others[other]()
    benchmark.group = "likelihood and gradient, n = 500, 4 outputs, 6 inputs"
    record_ratio(f"our step / {other}", ours, others[other], rounds=15)


def low(X):
    return (3 * X[..., :1]).sin() + X[..., 1:]


def high(X):
    return (1 + 0.3 * X[..., :1]) * low(X) + X[..., 1:].square()


@pytest.mark.parametrize("n", [8, 50, 200])
def test_fit_beside_mfk(benchmark, record_ratio, uniform, n):
    mfk = pytest.importorskip("smt.applications").MFK
    X_low = uniform(2 * n, 2)
    X = X_low[:n]
    noise = 0.01 * torch.randn(n, 1, dtype=torch.float64)

    def ours():
        fit(CKA(X, high(X) + noise, physics=low), "map")

    def theirs():
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = mfk(theta0=[1.0] * 2, print_global=False)
            model.set_training_values(X_low.numpy(), low(X_low).numpy(), name=0)
            model.set_training_values(X.numpy(), (high(X) + noise).numpy())
            model.train()

    ours()
    benchmark.group = f"fit, n = {n}"
    record_ratio("fit of CKA / SMT's MFK", ours, theirs, rounds=3 if n < 50 else 1)


@pytest.mark.parametrize("n", [8, 20, 50])
def test_full_bayes(benchmark, record_ratio, uniform, n):
    X = uniform(n, 2)
    Y = high(X) + 0.01 * torch.randn(n, 1, dtype=torch.float64)

    def build_and(method):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit(CKA(X, Y, physics=low), method)

    build_and("map")
    benchmark.group = f"full Bayes, n = {n}"
    record_ratio(
        'fit(model, "bayes") / fit(model, "map")',
        lambda: build_and("bayes"),
        lambda: build_and("map"),
        rounds=3,
    )


def several(X, m):
    columns = [low(X)[:, 0], X.prod(-1), X.sum(-1), (4 * X[:, 1]).cos()]
    return torch.stack(columns[:m], dim=-1)


@pytest.mark.parametrize(("n", "m"), [(50, 1), (200, 1), (500, 1), (1000, 1), (2000, 1), (500, 4)])
def test_fit(benchmark, record_ratio, uniform, n, m):
    """At most 2.0 for n from 200 on, without loss: see tests/inference."""
    X = uniform(n, 2)
    noise = 0.01 * torch.randn(n, m, dtype=torch.float64)
    Y = (1 + 0.3 * X[:, :1]) * several(X, m) + X[:, 1:].square() + noise

    def ours():
        fit(CKA(X, Y, physics=lambda X: several(X, m)), "map")

    def theirs():
        model = SingleTaskGP(X, Y)
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))

    benchmark.group = f"fit beside fit_gpytorch_mll, n = {n}, {m} output(s)"
    record_ratio("fit of CKA / BoTorch's of a SingleTaskGP", ours, theirs, 3 if n < 1000 else 1)
