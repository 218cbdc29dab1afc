"""Noise by name: relative to the physics, and with heavy tails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gpytorch.likelihoods import Likelihood

_NAMES = ("relative", "heavy-tailed")


def named_noise(names: str | Sequence[str], make: Any) -> Likelihood | None:
    """The likelihood of names, for a builder of terms; None for the model's own.

    Raises:
        TypeError: If there is no noise of a name.
    """
    names = [names] if isinstance(names, str) else [*names]
    if unknown := [name for name in names if name not in _NAMES]:
        raise TypeError(
            f"Expected {', '.join(map(repr, _NAMES))}, a sequence of both, or a Gaussian likelihood "
            f"of GPyTorch, got {unknown[0]!r}."
        )
    if "heavy-tailed" in names:
        from gpadjust.models.heavy_tails import HeavyTails

        make.sources.append(HeavyTails())
    return None
