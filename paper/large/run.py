"""Fitting a model of many observations, and its scores."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any

import torch

from gpadjust import CKA, VariationalCKA, fit
from paper.common.experiment import Record
from paper.large import Large
from paper.large.problem import Data, draw

_TEST = 10_000  # added to the seed


def run(
    experiment: Large, problem: str, learner: str, observations: int, seed: int, *, unfinished: Path
) -> Record:
    """Fit the model; the errors of f and of its intervals, of each output.

    Errors are in standard deviations of the function; ``seconds`` are those of building and
    fitting, with one thread.
    """
    settings = experiment.settings
    data, test = draw(problem, observations, seed), draw(problem, settings.num_test, seed + _TEST)
    # A first fit loads what any later one needs.
    fit(CKA(data.X[:10], data.Y[:10], physics=data.physics), "map")
    begin = time.perf_counter()
    if learner == "exact":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            model: Any = CKA(data.X, data.Y, physics=data.physics)
    else:
        model = VariationalCKA(
            data.X, data.Y, physics=data.physics, num_inducing=settings.num_inducing
        )
    fit(model)
    found = {"seconds": time.perf_counter() - begin, **_scores(model, test)}
    if learner == "variational":
        rest = model.rest.kernel.outputscale.sqrt() * model.outcome_transform.stdvs.flatten()
        found["rest_sd"] = (rest / test.f.std(0)).tolist()
        with torch.no_grad():
            model.rest.kernel.raw_outputscale.fill_(-40.0)
        model.forget()
        found["coverage_without_rest"] = _scores(model, test)["coverage"]
    noise = model.likelihood.noise.sqrt().reshape(-1, test.f.shape[-1]).mean(0)
    found["noise_sd"] = (noise * model.outcome_transform.stdvs.flatten() / test.f.std(0)).tolist()
    return found


def _scores(model: Any, test: Data) -> Record:
    with torch.no_grad():
        mean, _ = model.predict(test.X)
        lower, upper = model.interval(test.X)
    spread = test.f.std(0)
    inside = ((test.f >= lower) & (test.f <= upper)).double()
    width = (upper - lower).mean(0) / spread
    return {
        "rmse": ((mean - test.f).square().mean(0).sqrt() / spread).tolist(),
        "coverage": inside.mean(0).tolist(),
        "width": width.tolist(),
    }
