"""Noise by name: relative to the physics, and with heavy tails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gpytorch.likelihoods import Likelihood

_NAMES = ("relative", "heavy-tailed")


def named_noise(names: str | Sequence[str], make: Any) -> Likelihood | None:
    """The likelihood of names, for a builder of terms; None for the model's own.

    Raises:
        ValueError: If there is no noise of a name.
    """
    names = [names] if isinstance(names, str) else [*names]
    if unknown := [name for name in names if name not in _NAMES]:
        raise ValueError(
            f"Expected likelihood as {' or '.join(map(repr, _NAMES))}, or both in a sequence, got "
            f"{unknown[0]!r}."
        )
    return None
