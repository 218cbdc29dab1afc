"""What dynamics have learnt, as one value."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics.transitions import Transitions
from gpadjust.models import TermsModel
from gpadjust.states import StateSpec


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
    fitted: TermsModel
    model: TermsModel

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


class LearntState(NamedTuple):
    """What :meth:`Learnt.state_dict` holds, once it is found to be whole.

    Args:
        data: As in :class:`Learnt`, like ``known``, ``chunks`` and ``searched_at``.
        parameters: The state of the fitted model.
    """

    data: Transitions
    known: Tensor | None
    chunks: tuple[int, ...]
    searched_at: int
    parameters: dict[str, Tensor]

    @classmethod
    def checked(cls, state: Mapping[str, Any], spec: StateSpec, num_known: int) -> LearntState:
        """Take a state.

        Args:
            state: The state; its tensors are copied.
            spec: What the entries of states and actions are.
            num_known: The number of columns of what the physics says, 0 without one.

        Raises:
            RuntimeError: If something is missing, or not what it should be.
        """
        for name in ("transitions", "physics", "chunks", "searched_at", "model"):
            if name not in state:
                raise RuntimeError(f"The state is damaged: it lacks {name!r}.")
        given, known, parameters = state["transitions"], state["physics"], state["model"]
        if not isinstance(given, Mapping) or {*given} != {*Transitions._fields}:
            raise _damaged("transitions", f"a dictionary of {', '.join(Transitions._fields)}")
        try:
            data = Transitions.checked(spec, **given)
        except (TypeError, ValueError) as error:
            raise RuntimeError(f"The state is damaged in its transitions. {error}") from error
        n = len(data.states)
        if known is None and num_known:
            raise RuntimeError(
                "The state is of dynamics without a physics, but there is one here. Load it into "
                "dynamics built as they were."
            )
        if known is not None and not num_known:
            raise RuntimeError(
                "The state is of dynamics with a physics, but there is none here. Load it into "
                "dynamics built as they were."
            )
        if known is not None and not _is_finite(known, (n, num_known)):
            raise _damaged("physics", f"finite float64 values of shape {(n, num_known)}")
        chunks, searched_at = state["chunks"], state["searched_at"]
        whole = isinstance(chunks, list | tuple) and all(_is_count(size, n) for size in chunks)
        if not whole or sum(chunks) != n:
            raise _damaged("chunks", f"numbers of transitions, {n} in all")
        if not _is_count(searched_at, n):
            raise _damaged("searched_at", f"a number of transitions, at most {n}")
        named = isinstance(parameters, Mapping)
        if not named or any(not torch.is_tensor(t) or t.isnan().any() for t in parameters.values()):
            raise _damaged("model", "a dictionary of tensors without NaN")
        known = None if known is None else known.clone()
        return cls(data, known, tuple(chunks), searched_at, dict(parameters))


def _is_finite(values: Any, shape: tuple[int, int]) -> bool:
    found = torch.is_tensor(values) and values.dtype == torch.float64 and values.shape == shape
    return found and bool(values.isfinite().all())


def _is_count(number: Any, most: int) -> bool:
    return isinstance(number, int) and 1 <= number <= most


def _damaged(name: str, expected: str) -> RuntimeError:
    return RuntimeError(f"The state is damaged: expected {name!r} as {expected}.")
