"""Fit a data set by a method of inference, and score what it predicts."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust import CKA, StackedGP, compare, fit
from gpadjust.inference import SamplingWarning
from gpadjust.models import TermsGP
from gpadjust.physics import Physics
from gpadjust.validation import score
from paper.calibration import PUMP, Calibration, Method
from paper.common.experiment import Record
from paper.multifidelity.problem import observations, pair

_CHUNK = 50  # points predicted jointly, for the sake of memory


class Data(NamedTuple):
    """What a model learns from, and what it is scored at.

    Attributes:
        X: Inputs, ``n x d``.
        Y: Noisy observations, ``n x m``.
        physics: f_p.
        points: ``n' x d``.
        truth: The truth there, ``n' x m``.
        noise: The standard deviation of the noise of each output, ``m``.
    """

    X: Tensor
    Y: Tensor
    physics: Physics | Callable[[Tensor], Tensor]
    points: Tensor
    truth: Tensor
    noise: Tensor


def run(
    experiment: Calibration,
    problem: str,
    per_input: int,
    noise: float,
    method: Method,
    seed: int,
    *,
    unfinished: Path,
) -> Record:
    """Fit one data set; return scores of new observations, means over the outputs."""
    _prepare(method)
    if problem == PUMP:
        data = pump(experiment.settings.num_pump, seed)
    else:
        data = of_pair(problem, per_input, noise, experiment.settings.num_test, seed)
    start = time.perf_counter()
    model, warned = fitted(data, method)
    seconds = time.perf_counter() - start
    found = scored(model, data, seed)
    return {
        "N": len(data.X),
        **{name: each.mean().item() for name, each in found.items()},
        "seconds": seconds,
        "warned": warned,
    }


def scored(model: TermsGP | StackedGP, data: Data, seed: int) -> dict[str, Tensor]:
    """Errors of the mean against the truth; density and coverage of new observations; ``m`` each.

    Args:
        model: Fitted to the data.
        data: What it is scored at; errors and densities are in standard deviations of the truth.
        seed: Of the data set.
    """
    generator = torch.Generator().manual_seed(seed + 1_000)
    new = data.noise * torch.randn(data.truth.shape, generator=generator, dtype=torch.float64)
    sd = data.truth.std(0)
    with torch.no_grad():
        seen = [
            score(model.posterior(X, observation_noise=True), Y)
            for X, Y in zip(
                data.points.split(_CHUNK), (data.truth + new).split(_CHUNK), strict=True
            )
        ]
        mean = torch.cat([model.predict(X).mean for X in data.points.split(_CHUNK)])
    sizes = torch.tensor([len(each.pit) for each in seen], dtype=torch.float64)
    nlpd = (torch.stack([each.nlpd for each in seen]) * sizes.unsqueeze(-1)).sum(0) / sizes.sum()
    away = (torch.cat([each.pit for each in seen]) - 0.5).abs()
    return {
        "nrmse": (mean - data.truth).square().mean(0).sqrt() / sd,
        "nlpd": nlpd - sd.log(),
        "coverage": (away <= 0.475).double().mean(0),
        "half": (away <= 0.25).double().mean(0),
    }


def of_pair(name: str, per_input: int, noise: float, num_test: int, seed: int) -> Data:
    """Observations of a pair of functions, with noise in standard deviations of the truth."""
    problem = pair(name)
    X, Y = observations(problem, per_input * problem.d, seed)
    test_X = problem.sobol(num_test, seed=0)
    test_Y = problem.truth(test_X)
    sd = noise * test_Y.std(0)
    generator = torch.Generator().manual_seed(seed + 2_000)
    Y = Y + sd * torch.randn(Y.shape, generator=generator, dtype=torch.float64)
    return Data(X, Y, problem.physics(), test_X, test_Y, sd)


def pump(n: int, seed: int) -> Data:
    """A centrifugal pump: pressure in Pa and flow in m3/s over speed in rpm and valve opening.

    The physics has the affinity laws with the catalogue's curve; the real pump leaks and is worn.
    """

    def curve(X: Tensor, wear: float, leak: float) -> Tensor:
        speed, valve = X[..., 0] / 3000, X[..., 1]
        resistance = 0.2 + (1 - valve).square() * 3
        flow = speed / (1 + resistance) ** 0.5
        head = speed.square() - wear * flow.square() - leak * speed * (1 - valve)
        return torch.stack([2.5e5 * head, 5e-3 * flow * (1 - leak * (1 - valve))], dim=-1)

    def physics(X: Tensor) -> Tensor:
        return curve(X, 0.3, 0.0)

    low, high = torch.tensor([1000.0, 0.1]).double(), torch.tensor([3000.0, 1.0]).double()
    generator = torch.Generator().manual_seed(seed)
    X = low + (high - low) * torch.rand(n, 2, generator=generator, dtype=torch.float64)
    noise = torch.tensor([2500.0, 5e-5], dtype=torch.float64)
    truth = curve(X, 0.55, 0.15)
    Y = truth + noise * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    axes = [torch.linspace(0, 1, 25, dtype=torch.float64)] * 2
    test_X = low + (high - low) * torch.cartesian_prod(*axes)
    return Data(X, Y, physics, test_X, curve(test_X, 0.55, 0.15), noise)


def fitted(data: Data, method: Method) -> tuple[TermsGP | StackedGP, bool]:
    """A model fitted by a method, and whether it said that its draws are not of the posterior."""
    if method == "compare":
        return compare(data.X, data.Y, data.physics).recommended, False
    center: Any = 0.0 if method in ("map", "literal") else "learn"
    model = CKA(data.X, data.Y, physics=data.physics, center=center)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if method == "map":
            fit(model, "map")
        elif method == "long":
            fit(model, num_draws=16_384, num_samples=128)
        else:
            fit(model)
    for each in caught:
        if not issubclass(each.category, OptimizationWarning | SamplingWarning):
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return model, any(issubclass(each.category, SamplingWarning) for each in caught)


@cache
def _prepare(method: Method) -> None:
    """Set a process up: one fit of the method that is not timed."""
    if method != "long":
        fitted(of_pair("forrester", 5, 0.0, 10, 4), method)
