"""Dynamics in plain values: what they are, what they learnt, and whether a physics is the same."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict
from types import FunctionType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics.targets import next_values, warn_of_differences
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import Physics, PhysicsError
from gpadjust.states import StateSpec

_PROBES = 3
_OF_SPREAD = 1e-4  # of what the physics returns, by which another machine's may differ
_OF_SIZE = 1e-6  # of the states that it is computed from


def fingerprint(kind: type, spec: StateSpec, **settings: Any) -> dict[str, str]:
    """Return class, spec and settings of dynamics, each as a text."""
    # Where nothing is integrated, the step is but the unit of horizons.
    step = spec.step if spec.integrated else None
    settings = {**asdict(spec), "step": step, **settings}
    return {"class": kind.__name__, **{name: _text(value) for name, value in settings.items()}}


def _text(value: Any) -> str:
    """Return the value of plain objects, the name of classes and functions, the class of others."""
    if isinstance(value, Mapping):
        items = sorted((str(key), _text(part)) for key, part in value.items())
        return "{" + ", ".join(f"{key!r}: {part}" for key, part in items) + "}"
    if isinstance(value, list | tuple):
        return "(" + ", ".join(map(_text, value)) + ")"
    if isinstance(value, float):
        return repr(float(value))  # NumPy's print their type
    if value is None or isinstance(value, bool | int | str):
        return repr(value)
    is_named = isinstance(value, type | FunctionType)
    return value.__name__ if is_named else f"<{type(value).__name__}>"


@contextmanager
def loading(state: Any, expected: dict[str, str]) -> Iterator[dict[str, Any]]:
    """Yield a copy of a state of dynamics; raise a RuntimeError where it cannot be loaded."""
    if not isinstance(state, Mapping):
        raise TypeError(f"Expected a dictionary that `state_dict` gave, found {state!r}.")
    found = state.get("fingerprint")
    if not isinstance(found, Mapping):
        raise RuntimeError(
            "The state does not say of what dynamics it is; expected one that `state_dict` gave, "
            f"with a 'fingerprint'. It holds {sorted(map(str, state))}."
        )
    differences = [
        f"{name} is {found.get(name, 'missing')} in the state, {expected.get(name, 'missing')} here"
        for name in {**expected, **found}
        if found.get(name) != expected.get(name)
    ]
    if differences:
        raise RuntimeError(
            f"The state is of {found.get('class')} with other settings than this "
            f"{expected['class']}: {'; '.join(differences)}. Load it into dynamics built as they "
            "were."
        )
    try:
        yield deepcopy(dict(state))
    except PhysicsError:
        raise
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise RuntimeError(
            f"The state is damaged: {error!r}. Load one that `state_dict` gave, or learn from its "
            "transitions again."
        ) from error


def check_numbers(tensors: Mapping[str, Tensor]) -> None:
    """Raise a ValueError if one of a state's tensors has NaN."""
    for name, tensor in tensors.items():
        if tensor.isnan().any():
            raise ValueError(f"expected {name!r} without NaN")


def columns_of(data: Trajectories) -> dict[str, Tensor]:
    """Return the columns of transitions, as :meth:`Trajectories.checked` takes them."""
    return dict(zip(("states", "actions", "next_states"), data, strict=True))


class PhysicsProbes(NamedTuple):
    """A few transitions, and what a physics returns at these, with the guesses of parameters."""

    states: Tensor  # k x state_dim
    actions: Tensor  # k x action_dim
    changes: Tensor  # of the states that move, k x m
    tolerance: Tensor  # by how much the same physics may differ, m

    @classmethod
    def of(cls, physics: Physics, spec: StateSpec, data: Trajectories) -> PhysicsProbes:
        """Take of each third of the rows that where the physics returns what is least usual.

        There is a warning if it seems to return changes.
        """
        with torch.no_grad():
            following = next_values(physics, spec, data.states, data.actions)
        warn_of_differences(physics.name, spec, data, following)
        changes = spec.change(data.states, following)[:, spec.moving]
        departure = (changes - changes.mean(0)).abs()
        spread = departure.square().mean(0).sqrt()
        unusual = (departure / spread.clamp_min(torch.finfo(spread.dtype).tiny)).amax(-1)
        parts = [rows for rows in torch.arange(len(data)).tensor_split(_PROBES) if len(rows)]
        chosen = torch.stack([rows[unusual[rows].argmax()] for rows in parts])
        size = torch.cat([data.states[:, spec.moving], changes]).abs().amax(0)
        tolerance = _OF_SPREAD * spread + _OF_SIZE * size
        return cls(data.states[chosen], data.actions[chosen], changes[chosen], tolerance)

    def check(self, physics: Physics, spec: StateSpec) -> None:
        """Raise a PhysicsError, which is a RuntimeError, if a physics returns something else."""
        check_numbers(self._asdict())
        physics.forget()  # a file of another day: it may have changed
        with torch.no_grad():
            following = next_values(physics, spec, self.states, self.actions)
        expected = self.states.clone()
        expected[:, spec.moving] += self.changes
        gap = spec.change(expected, following)[:, spec.moving].abs()
        if (gap <= self.tolerance).all():
            return
        row, column = divmod(int((gap - self.tolerance).argmax()), gap.shape[-1])
        i = spec.moving[column]
        raise PhysicsError(
            f"The state is of dynamics with another physics than {physics.name!r} here. In the "
            f"state {self.states[row].tolist()}, after the action {self.actions[row].tolist()}, "
            f"that one said {float(expected[row, i]):.6g} of {spec.states[i]!r}, this one says "
            f"{float(following[row, i]):.6g}. Load the state into dynamics of the physics that it "
            "was learnt with, or learn from its transitions again. A physics that is not "
            "deterministic looks the same: dynamics need one that says the same each time."
        )
