"""Problems whose outputs are curves, with a formula that lacks something."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor


class CurveProblem(NamedTuple):
    """A true system, its formula, and what is measured.

    Attributes:
        coordinate: Of the outputs, ``m``.
        lower: Of the inputs, ``d``; ``upper`` likewise.
        physics: The formula, ``n x d`` to ``n x m``.
        truth: The true curves, likewise.
        rows: How many are measured.
        noise: Standard deviation of the measurements.
    """

    coordinate: Tensor
    lower: Tensor
    upper: Tensor
    physics: Callable[[Tensor], Tensor]
    truth: Callable[[Tensor], Tensor]
    rows: int
    noise: float

    def inputs(self, number: int, generator: torch.Generator) -> Tensor:
        """Uniform inputs, ``number x d``."""
        share = torch.rand(number, len(self.lower), generator=generator, dtype=torch.float64)
        return self.lower + share * (self.upper - self.lower)


def oscillator(m: int = 200) -> CurveProblem:
    """Response of a damped oscillator over 10 s, whose spring has a cubic part that f_p lacks.

    Inputs are frequency (rad/s), damping (1/s) and the position that it is released from (m).
    """
    t = torch.linspace(0, 10, m, dtype=torch.float64)

    def linear(X: Tensor) -> Tensor:
        omega, damping, start = (column.unsqueeze(-1) for column in X.unbind(-1))
        own = (omega.square() - damping.square()).sqrt()
        swing = (own * t).cos() + damping / own * (own * t).sin()
        return start * (-damping * t).exp() * swing

    def cubic(X: Tensor, steps: int = 400) -> Tensor:
        omega, damping, start = X.unbind(-1)
        h = 10.0 / steps

        def slope(state: Tensor) -> Tensor:
            x, v = state.unbind(-1)
            pull = omega.square() * (x + 0.05 * x**3) + 2 * damping * v
            return torch.stack([v, -pull], -1)

        state = torch.stack([start, torch.zeros_like(start)], -1)
        path = [state[..., 0]]
        for _ in range(steps):
            a = slope(state)
            b = slope(state + h / 2 * a)
            c = slope(state + h / 2 * b)
            d = slope(state + h * c)
            state = state + h / 6 * (a + 2 * b + 2 * c + d)
            path.append(state[..., 0])
        every = torch.stack(path, -1)  # n x (steps + 1)
        place = t / h
        low = place.floor().long().clamp_max(steps - 1)
        return every[:, low].lerp(every[:, low + 1], place - low)

    ends = torch.tensor([[0.8, 0.1, 0.5], [1.4, 0.3, 1.5]], dtype=torch.float64)
    return CurveProblem(t, ends[0], ends[1], linear, cubic, 30, 0.02)


def diffusion() -> CurveProblem:
    """Profile of a substance that diffuses into a wall of 1 cm, where it decays, which f_p lacks.

    Inputs are the diffusivity (cm^2/h) and the time (h); the concentration at the surface is 1.
    """
    x = torch.linspace(0, 1, 100, dtype=torch.float64)

    def diffuses(X: Tensor) -> Tensor:
        d, time = (column.unsqueeze(-1) for column in X.unbind(-1))
        return torch.erfc(x / (2 * (d * time).sqrt()))

    def decays(X: Tensor) -> Tensor:  # Danckwerts (1951), with the rate 1.5 per hour
        d, time = (column.unsqueeze(-1) for column in X.unbind(-1))
        reach, spread = x * (1.5 / d).sqrt(), 2 * (d * time).sqrt()
        rest = (1.5 * time).sqrt()
        near = (-reach).exp() * torch.erfc(x / spread - rest)
        return 0.5 * (near + reach.exp() * torch.erfc(x / spread + rest))

    ends = torch.tensor([[0.05, 0.2], [0.3, 1.5]], dtype=torch.float64)
    return CurveProblem(x, ends[0], ends[1], diffuses, decays, 20, 0.01)


def spectrum() -> CurveProblem:
    """Spectrum of two substances with narrow lines; f_p lacks saturation and the background.

    Inputs are both concentrations and the temperature (100 K).
    """
    w = torch.linspace(400, 700, 300, dtype=torch.float64)

    def line(center: float, width: Tensor | float) -> Tensor:
        return 1 / (1 + ((w - center) / width) ** 2)

    def beer(X: Tensor) -> Tensor:
        a, b, _ = (column.unsqueeze(-1) for column in X.unbind(-1))
        return a * (line(480, 6.0) + 0.6 * line(560, 8.0)) + b * (line(520, 5.0) + line(640, 7.0))

    def measured(X: Tensor) -> Tensor:
        _, b, heat = (column.unsqueeze(-1) for column in X.unbind(-1))
        f = beer(X)
        background = 0.1 * heat.square() * torch.exp(-(w - 400) / 150) * (1 + 0.3 * b)
        return f / (1 + 0.3 * f) + background

    ends = torch.tensor([[0.1, 0.1, 2.5], [1.0, 1.0, 4.0]], dtype=torch.float64)
    return CurveProblem(w, ends[0], ends[1], beer, measured, 40, 0.005)


PROBLEMS: dict[str, Callable[[], CurveProblem]] = {
    "oscillator": oscillator,
    "diffusion": diffusion,
    "spectrum": spectrum,
}


def measured(problem: CurveProblem, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Training inputs and noisy curves, 100 test inputs and their true curves."""
    generator = torch.Generator().manual_seed(seed)
    X, test_X = problem.inputs(problem.rows, generator), problem.inputs(100, generator)
    m = len(problem.coordinate)
    noise = torch.randn(len(X), m, generator=generator, dtype=torch.float64)
    return X, problem.truth(X) + problem.noise * noise, test_X, problem.truth(test_X)


def relative(error: Tensor, truth: Tensor) -> float:
    """Root mean square error over the standard deviation of the truth."""
    return math.sqrt(float(error.square().mean() / truth.var()))
