"""The random generators that a run draws from."""

from __future__ import annotations

import random
from typing import Any, NamedTuple, Self

import numpy as np
import torch


class RandomState(NamedTuple):
    """The state of the global generators of Python, NumPy and PyTorch, from which a run draws."""

    python: Any
    numpy: Any
    torch: Any
    cuda: list[Any]

    @staticmethod
    def seed(seed: int) -> None:
        """Seed all of them."""
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - the generator that SB3 uses
        torch.manual_seed(seed)

    @classmethod
    def capture(cls) -> Self:
        """Return the present state, in tensors and plain values."""
        name, keys, *others = np.random.get_state()  # noqa: NPY002
        return cls(
            random.getstate(),
            (name, np.asarray(keys).tolist(), *others),
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
