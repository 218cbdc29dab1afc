"""What a cloud of particles says: its centre, what a measurement adds, and intervals."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.states import StateSpec

_ROUNDING = 1e-9  # of a number of particles


def about_centre(spec: StateSpec, particles: Tensor) -> tuple[Tensor, Tensor]:
    """The centre ``... x state_dim`` of particles ``K x ... x state_dim``, and how far they are.

    Where angles went round different ways, their centre is the mean on the circle, and how far each
    is from it is the shortest way round.
    """
    centre = particles.mean(0)
    for i in spec.angle_columns:
        angle = particles[..., i]
        centre[..., i] = torch.atan2(angle.sin().mean(0), angle.cos().mean(0))
    return centre, spec.change(centre.expand_as(particles), particles)


def measurement_noise(
    spec: StateSpec, noise: Tensor, num_particles: int, generator: torch.Generator
) -> Tensor:
    """Draws of a noise with standard deviations ``... x state_dim``, one for each particle.

    An integrated state has the draws of its velocity.
    """
    z = torch.randn(num_particles, *noise.shape, generator=generator, dtype=torch.float64)
    for name, velocity in spec.integrated.items():
        z[..., spec.states.index(name)] = z[..., spec.states.index(velocity)]
    return noise * z


def central_interval(sample: Tensor, level: float) -> tuple[Tensor, Tensor]:
    """What a further draw lies between with this probability, from ``K x ...``: ``...`` each."""
    low, high = (_order_statistic(sample, p) for p in ((1 - level) / 2, (1 + level) / 2))
    return low, high


def check_enough(num_functions: int, level: float) -> None:
    """Raise a ValueError unless so many particles have an interval of this probability."""
    checked_whole("num_functions", num_functions, 1)
    least = math.ceil(2 / (1 - level) - 1 - _ROUNDING)  # whose outermost two are its ends
    if num_functions < least:
        raise ValueError(
            f"Expected num_functions >= {least}, without which there are no ends of an "
            f"interval of {100 * level:g} %, got {num_functions}."
        )


def _order_statistic(sample: Tensor, level: float) -> Tensor:
    """What a further draw is below with this probability, from ``K x ...``: ``...``.

    The i-th smallest of K draws is so with probability i / (K + 1); between them it is a line.
    """
    ordered = sample.sort(0).values
    place = level * (len(sample) + 1) - 1
    below = min(max(int(place), 0), len(sample) - 2)
    return ordered[below].lerp(ordered[below + 1], min(max(place - below, 0.0), 1.0))
