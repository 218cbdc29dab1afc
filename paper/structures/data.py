"""Data sets of functions, and the scores of models that learn from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core import GP
from gpadjust.physics import Physics
from gpadjust.validation import score
from paper.structures.functions import PAIRS, observations

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


def scored(model: GP, data: Data, seed: int) -> dict[str, Tensor]:
    """Errors of the mean against the truth; density and coverage of new observations; ``m`` each.

    Args:
        model: Fitted to the data.
        data: What it is scored at; errors and densities are in standard deviations of the truth.
        seed: Of the data set.
    """
    generator = torch.Generator().manual_seed(seed + 1_000)
    new = data.noise * torch.randn(data.truth.shape, generator=generator, dtype=torch.float64)
    sd = data.truth.std(0)
    parts = zip(data.points.split(_CHUNK), (data.truth + new).split(_CHUNK), strict=True)
    with torch.no_grad():
        seen = [score(model.posterior(X, observation_noise=True), Y) for X, Y in parts]
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
    problem = PAIRS[name]
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

    low, high = torch.tensor([1000.0, 0.1]).double(), torch.tensor([3000.0, 1.0]).double()
    generator = torch.Generator().manual_seed(seed)
    X = low + (high - low) * torch.rand(n, 2, generator=generator, dtype=torch.float64)
    noise = torch.tensor([2500.0, 5e-5], dtype=torch.float64)
    truth = curve(X, 0.55, 0.15)
    Y = truth + noise * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    axes = [torch.linspace(0, 1, 25, dtype=torch.float64)] * 2
    test_X = low + (high - low) * torch.cartesian_prod(*axes)
    return Data(X, Y, lambda X: curve(X, 0.3, 0.0), test_X, curve(test_X, 0.55, 0.15), noise)
