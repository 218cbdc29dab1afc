"""Random functions of one to eight inputs, and fits of them."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from gpadjust import CKA, fit
from gpadjust.inference import SamplingWarning
from paper.common.experiment import Record
from paper.seeds import LONG, MANY, SETS, SMOOTH, Data, Seeds

_MANY = 4096  # points that tell the size of a function

Function = Callable[[Tensor], Tensor]


def functions(num_inputs: int, seed: int) -> tuple[Function, Function]:
    """A smooth function of weights that are drawn, and its physics: ``n x d`` to ``n x 1``."""
    generator = torch.Generator().manual_seed(seed)
    sizes = torch.logspace(0.0, -0.8, num_inputs, dtype=torch.float64)
    a, b, c = (
        torch.randn(num_inputs, generator=generator, dtype=torch.float64)
        * sizes[torch.randperm(num_inputs, generator=generator)]
        for _ in range(3)
    )

    def crude(X: Tensor) -> Tensor:
        return (3 * X @ a + 0.5).cos() + X @ b

    def truth(X: Tensor) -> Tensor:
        return (1.2 + 0.4 * (2 * X @ c).sin()) * crude(X) + 0.3 * (X @ b - X @ a).square()

    X = SobolEngine(num_inputs, scramble=True, seed=seed).draw(_MANY, dtype=torch.float64)
    size = truth(X).std()
    return (lambda X: (truth(X) / size).unsqueeze(-1), lambda X: (crude(X) / size).unsqueeze(-1))


def run(experiment: Seeds, data: str, kind: str, seed: int, *, unfinished: Path) -> Record:
    """Fit a data set; what is predicted at new inputs."""
    (given,) = {each for each in SETS + SMOOTH if str(each) == data}
    settings, own = experiment.settings, seed if kind == MANY else 0
    X, Y, Z, truth, physics = _drawn(given, 1_000 * given.num_inputs + own, settings.points)
    model = CKA(X, Y, physics=physics)
    options: dict[str, Any] = {}
    if kind == LONG:
        first = max(128, min(1024, 5_120_000 // len(X) ** 2))
        options = {"num_draws": settings.effort * first, "num_samples": settings.samples}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        begin = time.process_time()
        fit(model, seed=seed, **options)
        seconds = time.process_time() - begin
    mean, variance = (each.squeeze(-1) for each in model.predict(Z))
    low, high = (each.squeeze(-1) for each in model.interval(Z))
    return {
        "mean": mean.tolist(),
        "sd": variance.sqrt().tolist(),
        "log_width": float((high - low).log().mean()),
        "held": float(((low <= truth) & (truth <= high)).double().mean()),
        "error": math.sqrt(float((mean - truth).square().mean())),
        "seconds": seconds,
        "warned": any(issubclass(each.category, SamplingWarning) for each in caught),
    }


def _drawn(given: Data, seed: int, points: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Function]:
    """Inputs, targets, new inputs, what is true there, and the physics."""
    truth, physics = functions(given.num_inputs, seed)
    generator = torch.Generator().manual_seed(seed)
    engine = SobolEngine(given.num_inputs, scramble=True, seed=seed)
    X = engine.draw(given.each * given.num_inputs, dtype=torch.float64)
    Y = truth(X)
    Y = Y + given.noise * torch.randn(Y.shape, generator=generator, dtype=Y.dtype)
    Z = torch.rand(points, given.num_inputs, generator=generator, dtype=torch.float64)
    return X, Y, Z, truth(Z).squeeze(-1), physics
