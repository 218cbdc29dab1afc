"""The random generators that a run draws from."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch


@dataclass(frozen=True)
class RandomState:
    """The state of the global generators of Python, NumPy and PyTorch."""

    python: Any
    numpy: Any
    torch: Any
    cuda: list[Any]

    @classmethod
    def capture(cls) -> Self:
        """Return the present state."""
        return cls(
            random.getstate(),
            np.random.get_state(),  # noqa: NPY002 - the generator that SB3 uses
            torch.get_rng_state(),
            torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        )

    def restore(self) -> None:
        """Go back to this state."""
        random.setstate(self.python)
        np.random.set_state(self.numpy)  # noqa: NPY002
        torch.set_rng_state(self.torch)
        if self.cuda and torch.cuda.is_available():
            torch.cuda.set_rng_state_all(self.cuda)
