"""Time of a likelihood step, a fit and full Bayes beside others; run with `--benchmark-only`."""

import contextlib
import io
import warnings

import pytest
import torch
from botorch.optim.closures import get_loss_closure_with_grads
from gpytorch.mlls import ExactMarginalLogLikelihood

from gpadjust import CKA, fit
from gpadjust.inference.targets import LogLikelihood


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


@pytest.mark.parametrize("points", [0, 100, 10_000], ids=["fit", "predict-100", "predict-10000"])
@pytest.mark.parametrize("row", [("currin", 5), ("hartmann6", 5), ("branin", 100)])
def test_default_beside_map(benchmark, record_ratio, row, points):
    """On data sets of paper/structures: fitting, or predicting at so many points."""
    from paper.structures.data import of_pair

    def fitted(data, method):
        if method == "default":
            model = CKA(data.X, data.Y, physics=data.physics)
            fit(model)
        else:
            model = CKA(data.X, data.Y, physics=data.physics, center=0.0)
            fit(model, "map")
        return model

    sets = [of_pair(*row, 0.0, 10, seed) for seed in range(3 if row[0] == "branin" else 5)]

    def models(method):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return [fitted(data, method) for data in sets]

    benchmark.group = f"default beside map, {row[0]}, n = {len(sets[0].X)}"
    if not points:
        record_ratio("fits", lambda: models("default"), lambda: models("map"), rounds=3)
        return
    Z = torch.cat([data.points for data in sets])
    low, high = Z.amin(0), Z.amax(0)
    Z = low + (high - low) * torch.rand(points, Z.shape[-1], dtype=torch.float64)
    default, most_likely = models("default"), models("map")

    def predict(found):
        with torch.no_grad():
            for model in found:
                model.predict(Z)

    name = f"predict at {points:,} points"
    record_ratio(name, lambda: predict(default), lambda: predict(most_likely), rounds=7)
