"""What dynamics have learnt, as one value."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics.transitions import Transitions
from gpadjust.models import ExactGPBase


class Learnt(NamedTuple):
    """Transitions, and the model of them; replaced as a whole, so that no error leaves half of it.

    Args:
        data: The transitions.
        known: What the physics says of the targets there, or None.
        chunks: Numbers of transitions: fitted, then conditioned on, one after the other.
        searched_at: The number of them at the last search of the hyper-parameters.
        fitted: The model of the first chunk.
        model: The model of all.
    """

    data: Transitions
    known: Tensor | None
    chunks: tuple[int, ...]
    searched_at: int
    fitted: ExactGPBase
    model: ExactGPBase

    def with_rows(self, data: Transitions, known: Tensor | None) -> tuple[Transitions, Any]:
        """All transitions, and what the physics says there, with those of further ones."""
        if self.known is not None and known is not None:
            known = torch.cat([self.known, known])
        return self.data.append(data), known

    def state_dict(self) -> dict[str, Any]:
        """All of it in tensors and plain values."""
        return {
            "transitions": {name: t.clone() for name, t in self.data._asdict().items()},
            "physics": None if self.known is None else self.known.clone(),
            "chunks": [*self.chunks],
            "searched_at": self.searched_at,
            "model": {name: t.clone() for name, t in self.fitted.state_dict().items()},
        }
