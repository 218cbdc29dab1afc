"""Noise by its name: relative to the physics, and with heavy tails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gpytorch.likelihoods import Likelihood

from gpadjust.models.heavy_tails import HeavyTails
from gpadjust.models.relative_noise import MeanSizes, RelativeNoise

_NAMES = ("relative", "heavy-tailed")


def named_noise(names: str | Sequence[str], make: Any) -> Likelihood | None:
    """The likelihood of names, for a builder of terms; None for the model's own.

    Raises:
        ValueError: If there is no noise of a name, or noise is to be relative in the units
            of a link.
    """
    names = [names] if isinstance(names, str) else [*names]
    if unknown := [name for name in names if name not in _NAMES]:
        raise ValueError(
            "Expected likelihood as 'relative', 'heavy-tailed', a sequence of both, or a Gaussian "
            f"likelihood of GPyTorch, got {unknown[0]!r}."
        )
    if "heavy-tailed" in names:
        make.sources.append(HeavyTails())
    if "relative" not in names:
        return None
    if make.link is not None:
        raise ValueError(
            "Expected no outcome_transform with bounds beside likelihood='relative': noise is then "
            "that of g(y), relative already for a logarithm. Leave one of them out."
        )
    if not make.f:
        make.sources.append(MeanSizes())
    return RelativeNoise(make)
