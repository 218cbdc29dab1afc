"""The methods on a pair of functions, and their scores."""

from __future__ import annotations

import time
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust import AR1, CKA, fit
from gpadjust.inference import SamplingWarning
from gpadjust.physics import PhysicsWarning
from gpadjust.validation import rmse
from paper.common.experiment import Record
from paper.multifidelity.problem import Pair, low_inputs, observations
from paper.multifidelity.run import SMTModel
from paper.polynomials import Polynomials, Settings
from paper.polynomials.functions import PAIRS

_CENTRAL = 1.959964  # standard deviations, within which 95 % of a normal distribution lie


def pair(name: str) -> Pair:
    """The pair of a given name."""
    of = PAIRS[name]
    return Pair(name, of.high, of.low, torch.tensor([of.lower, of.upper], dtype=torch.float64))


@cache
def _prepare(method: str, settings: Settings) -> None:
    """Set a process up: one fit of the method that is not timed."""
    small = pair("forrester")
    _fitted(method, small, *observations(small, 5, 0), settings.num_low, 0)


def run(
    experiment: Polynomials, name: str, n: int, method: str, seed: int, *, unfinished: Path
) -> Record:
    """Train a method on a data set; return its scores, in units of the truth's sd."""
    settings, problem = experiment.settings, pair(name)
    _prepare(method, settings)
    X, Y = observations(problem, n, seed)
    test_X = problem.sobol(settings.num_test, seed=0)
    test_Y = problem.truth(test_X)
    start = time.process_time()
    model = _fitted(method, problem, X, Y, settings.num_low, seed)
    seconds = time.process_time() - start
    with torch.no_grad():
        mean, lower, upper = _predicted(model, test_X)
    sd = test_Y.std()
    inside = (lower <= test_Y) & (test_Y <= upper)
    return {
        "nrmse": (rmse(mean, test_Y) / sd).item(),
        "coverage": inside.double().mean().item(),
        "width": ((upper - lower).mean() / sd).item(),
        "seconds": seconds,
    }


def _predicted(model: Any, X: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The mean, and where a function lies with 95 % probability, ``n x 1`` each."""
    if isinstance(model, SMTModel):
        posterior = model.posterior(X)
        away = _CENTRAL * posterior.variance.sqrt()
        return posterior.mean, posterior.mean - away, posterior.mean + away
    lower, upper = model.interval(X)
    return model.predict(X).mean, lower, upper


def _fitted(method: str, pair: Pair, X: Tensor, Y: Tensor, num_low: int, seed: int) -> Any:
    """A model by one of the methods; AR1 and MFK have the same samples of the low level."""
    low_X, physics = low_inputs(pair, X, max(num_low * pair.d, len(X)), seed), pair.physics()
    with warnings.catch_warnings():
        for category in (OptimizationWarning, SamplingWarning, PhysicsWarning):
            # A fit that has not converged, or a physics that is far off, is shown by its scores.
            warnings.filterwarnings("ignore", category=category)
        if method == "mfk":
            return SMTModel(low_X, physics(low_X), X, Y)
        model = (
            AR1(X, Y, physics=physics, low_X=low_X)
            if method == "ar1"
            else CKA(X, Y, physics=physics)
        )
        fit(model, "map" if method == "cka-map" else "bayes")
    return model
