"""Learn a data set, and score what is predicted."""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust import CKA, StackedGP, ZeroMeanGP, compare, fit
from gpadjust.models import TermsGP
from gpadjust.validation import score
from paper.choice import Choice
from paper.choice.problems import PROBLEMS
from paper.common.experiment import Record

_MANY = 4096  # points that mean and standard deviation of a function are of


def run(
    experiment: Choice, problem: str, per_input: int, method: str, seed: int, *, unfinished: Path
) -> Record:
    """Fit one data set; return scores, in standard deviations of the function."""
    _prepare()
    given, d = PROBLEMS[problem], PROBLEMS[problem].num_inputs
    mean, sd = _moments(problem)
    generator = torch.Generator().manual_seed(seed)

    def truth(X: Tensor) -> Tensor:
        return ((given.truth(X) - mean) / sd).unsqueeze(-1)

    def physics(X: Tensor) -> Tensor:
        return ((given.physics(X) - mean) / sd).unsqueeze(-1)

    X = SobolEngine(d, scramble=True, seed=seed).draw(per_input * d, dtype=torch.float64)
    Y = truth(X)
    Y = Y + given.noise * torch.randn(Y.shape, generator=generator, dtype=torch.float64)
    points = SobolEngine(d, scramble=True, seed=1).draw(
        experiment.settings.num_test, dtype=torch.float64
    )
    expected = truth(points)
    new = expected + given.noise * torch.randn(
        expected.shape, generator=generator, dtype=torch.float64
    )
    start, found = time.process_time(), dict[str, Any]()
    if method == "compare":
        comparison = compare(X, Y, physics)
        model: TermsGP | StackedGP = comparison.recommended
        found["chosen"] = comparison.chosen
        found["shown"] = comparison.gain["y"].shown
    else:
        model = ZeroMeanGP(X, Y) if method == "zero" else CKA(X, Y, physics=physics)
        relevance = fit(model, "bayes").relevance
        found["relevance"] = None if relevance is None else relevance.item()
    found["seconds"] = time.process_time() - start
    if method == "compare":
        found["single"] = {
            name: _rmse(each, points, expected) for name, each in comparison.models.items()
        }
    with torch.no_grad():
        scored = score(model.posterior(points, observation_noise=True), new)
        noisy, plain = (model.components(X[:1], noise)[1] for noise in (True, False))
    return {
        "rmse": _rmse(model, points, expected),
        "coverage": _held(model, points, expected),
        "measured": _held(model, X, truth(X)),
        "half": _held(model, points, expected, 0.5),
        "nlpd": scored.nlpd.item(),
        "noise": (noisy - plain).mean().clamp_min(0).sqrt().item(),
        **found,
    }


@cache
def _prepare() -> None:
    """Set a process up: a fit that is not timed."""
    X = torch.linspace(0, 1, 5, dtype=torch.float64).unsqueeze(-1)
    fit(CKA(X, X, physics=torch.sin))


@cache
def _moments(problem: str) -> tuple[float, float]:
    """Mean and standard deviation of a function."""
    given = PROBLEMS[problem]
    X = SobolEngine(given.num_inputs, scramble=True, seed=0).draw(_MANY, dtype=torch.float64)
    values = given.truth(X)
    return values.mean().item(), values.std().item()


def _rmse(model: TermsGP | StackedGP, X: Tensor, expected: Tensor) -> float:
    return (model.predict(X).mean - expected).square().mean().sqrt().item()


def _held(model: TermsGP | StackedGP, X: Tensor, expected: Tensor, level: float = 0.95) -> float:
    """The share of values of the function within intervals of it."""
    low, high = model.interval(X, level)
    return ((low <= expected) & (expected <= high)).double().mean().item()
