"""Times of the core beside those of the rooms that it will replace; run with `--benchmark-only`."""

import time

import pytest
import torch
from gpadjust.inference.targets import LogLikelihood

import gpadjust
from gpadjust import core


def wavy(X):
    return torch.sin(4 * X[..., :1]) * (1 + X[..., 1:2])


def problem(n):
    generator = torch.Generator().manual_seed(n)
    X = torch.rand(n, 2, generator=generator, dtype=torch.float64)
    noise = 0.03 * torch.randn(n, 1, generator=generator, dtype=torch.float64)
    return X, 1.3 * wavy(X) + 0.3 * X[:, :1] + noise


def fitted(room, X, Y):
    model = room.CKA(X, Y, physics=wavy)
    room.fit(model)
    return model


def steps(X, Y):
    """A likelihood and its gradient, of the core and of the rooms."""
    model = core.CKA(X, Y, physics=wavy, nested=False)
    u = 0.1 * torch.randn(1, *model.u.shape[1:], dtype=torch.float64)
    target = LogLikelihood(gpadjust.CKA(X, Y, physics=wavy))
    vectors = target.parameters.current()
    return lambda: model.log_likelihood(u), lambda: target.value_and_gradient(vectors)


@pytest.mark.parametrize("n", [12, 50, 200, 400])
def test_the_core(n, benchmark):
    X, Y = problem(n)
    Z = torch.rand(200, 2, dtype=torch.float64)
    new, old = fitted(core, X, Y), fitted(gpadjust, X, Y)
    pairs = {
        "step": steps(X, Y),
        "fit": (lambda: fitted(core, X, Y), lambda: fitted(gpadjust, X, Y)),
    }
    actions = {
        "predict": lambda model: model.predict(Z),
        "posterior": lambda model: model.posterior(Z[:5]).rsample(torch.Size([16])),
        "condition": lambda model: model.condition_on_observations(Z[:3], wavy(Z[:3])).predict(Z),
    }
    for name, action in actions.items():
        pairs[name] = tuple(lambda a=action, m=model: a(m) for model in (new, old))
    ratios = {name: ratio(*pair, 5 if name == "fit" else 31) for name, pair in pairs.items()}
    benchmark.pedantic(lambda: None, rounds=1)
    benchmark.extra_info.update(ratios)
    print(f"n = {n}: " + ", ".join(f"{name} {value:.2f}" for name, value in ratios.items()))


def ratio(ours, theirs, rounds):
    """The ratio of the median times of processor, by turns."""
    times = ([], [])
    for _ in range(rounds):
        for action, record in zip((ours, theirs), times, strict=True):
            start = time.process_time()
            action()
            record.append(time.process_time() - start)
    medians = [torch.tensor(record).median().item() for record in times]
    return medians[0] / medians[1]
