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

    def as_arrays(self) -> dict[str, np.ndarray]:
        """The state in arrays of numbers."""
        version, python, python_gauss = self.python
        _, keys, pos, has_gauss, gauss = self.numpy
        arrays = {
            "python": np.array([version, *python], dtype=np.uint64),
            "python_gauss": np.array([] if python_gauss is None else [python_gauss]),
            "numpy": np.array([*keys, pos, has_gauss], dtype=np.uint64),
            "numpy_gauss": np.array(gauss),
            "torch": self.torch.numpy(),
        }
        return arrays | {f"cuda{i}": state.numpy() for i, state in enumerate(self.cuda)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Self:
        """The state that :meth:`as_arrays` gave."""
        version, *python = map(int, arrays["python"])
        *keys, pos, has_gauss = map(int, arrays["numpy"])
        legacy = (np.array(keys, dtype=np.uint32), pos, has_gauss, float(arrays["numpy_gauss"]))
        gauss = arrays["python_gauss"].tolist()
        cuda = (f"cuda{i}" for i in range(len(arrays)))
        return cls(
            (version, tuple(python), gauss[0] if gauss else None),
            ("MT19937", *legacy),
            torch.from_numpy(arrays["torch"]),
            [torch.from_numpy(arrays[name]) for name in cuda if name in arrays],
        )
