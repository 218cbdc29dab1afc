"""Saved states of dynamics: their settings, and a comparison of the physics."""

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
_OF_SPREAD = 1e-4  # tolerance between machines, as a share of the spread of changes
_OF_SIZE = 1e-6  # the same, as a share of the size of states and changes


def fingerprint(kind: type, spec: StateSpec, **settings: Any) -> dict[str, str]:
    """Return class, spec and settings of dynamics, each as a text."""
    # If nothing is integrated, the step is only the unit of horizons.
    step = spec.step if spec.integrated else None
    settings = {**asdict(spec), "step": step, **settings}
    return {"class": kind.__name__, **{name: _text(value) for name, value in settings.items()}}


def _text(value: Any) -> str:
    """Return a plain object's value, the name of a class or function, the class of any other."""
    if isinstance(value, Mapping):
        items = sorted((str(key), _text(part)) for key, part in value.items())
        return "{" + ", ".join(f"{key!r}: {part}" for key, part in items) + "}"
    if isinstance(value, list | tuple):
        return "(" + ", ".join(map(_text, value)) + ")"
    if isinstance(value, float):
        return repr(float(value))  # the repr of NumPy's numbers has their type
    if value is None or isinstance(value, bool | int | str):
        return repr(value)
    if isinstance(value, type | FunctionType):
        return value.__name__
    return f"<{type(value).__name__}>"


@contextmanager
def loading(state: Any, expected: dict[str, str]) -> Iterator[dict[str, Any]]:
    """Yield a copy of a saved state; raise a RuntimeError if it cannot be loaded."""
    if not isinstance(state, Mapping):
        raise TypeError(f"Expected a dictionary from `state_dict`, found {state!r}.")
    settings = state.get("fingerprint")
    if not isinstance(settings, Mapping):
        raise RuntimeError(
            "Expected a state from `state_dict`, with a 'fingerprint' of the settings; found "
            f"{sorted(map(str, state))}."
        )
    differences = [
        f"{name} is {settings.get(name, 'missing')} in the state, "
        f"{expected.get(name, 'missing')} here"
        for name in {**expected, **settings}
        if settings.get(name) != expected.get(name)
    ]
    if differences:
        raise RuntimeError(
            f"The state is of {settings.get('class')} with other settings than this "
            f"{expected['class']}: {'; '.join(differences)}. Load it into dynamics with the same "
            "settings."
        )
    try:
        yield deepcopy(dict(state))
    except PhysicsError:
        raise
    except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise RuntimeError(
            f"The state is damaged: {error!r}. Load another one from `state_dict`, or update new "
            "dynamics by its transitions."
        ) from error


def check_numbers(tensors: Mapping[str, Tensor]) -> None:
    """Raise a ValueError if one of the tensors has NaN."""
    for name, tensor in tensors.items():
        if tensor.isnan().any():
            raise ValueError(f"expected {name!r} without NaN")


def columns_of(data: Trajectories) -> dict[str, Tensor]:
    """Return the columns of transitions as arguments of :meth:`Trajectories.checked`."""
    return dict(zip(("states", "actions", "next_states"), data, strict=True))


class PhysicsProbes(NamedTuple):
    """A few transitions, and the outputs of a physics there, at the guesses of its parameters."""

    states: Tensor  # k x state_dim
    actions: Tensor  # k x action_dim
    changes: Tensor  # of the states that move, k x m
    tolerance: Tensor  # largest difference of the same physics, m

    @classmethod
    def from_data(cls, physics: Physics, spec: StateSpec, data: Trajectories) -> PhysicsProbes:
        """Return the row with the least usual output of the physics of each third of the rows.

        Warn if the physics seems to return changes.
        """
        with torch.no_grad():
            following = next_values(physics, spec, data.states, data.actions)
        warn_of_differences(physics.name, spec, data, following)
        changes = spec.change(data.states, following)[:, spec.moving]
        deviation = (changes - changes.mean(0)).abs()
        spread = deviation.square().mean(0).sqrt()
        # The largest deviation of a row in standard deviations: the least usual row tells most.
        unusual = (deviation / spread.clamp_min(torch.finfo(spread.dtype).tiny)).amax(-1)
        parts = [rows for rows in torch.arange(len(data)).tensor_split(_PROBES) if len(rows)]
        probes = torch.stack([rows[unusual[rows].argmax()] for rows in parts])
        size = torch.cat([data.states[:, spec.moving], changes]).abs().amax(0)
        tolerance = _OF_SPREAD * spread + _OF_SIZE * size
        return cls(data.states[probes], data.actions[probes], changes[probes], tolerance)

    def check(self, physics: Physics, spec: StateSpec) -> None:
        """Raise a PhysicsError, which is a RuntimeError, if a physics returns something else."""
        check_numbers(self._asdict())
        physics.forget()  # a file or a program may have changed since
        with torch.no_grad():
            following = next_values(physics, spec, self.states, self.actions)
        # Predicted changes within the tolerance; angles the shortest way round.
        expected = self.states.clone()
        expected[:, spec.moving] += self.changes
        gap = spec.change(expected, following)[:, spec.moving].abs()
        if (gap <= self.tolerance).all():
            return
        row, column = divmod(int((gap - self.tolerance).argmax()), gap.shape[-1])
        i = spec.moving[column]
        raise PhysicsError(
            f"The saved dynamics have another physics than {physics.name!r} here. In the state "
            f"{self.states[row].tolist()}, with the action {self.actions[row].tolist()}, that one "
            f"returned {float(expected[row, i]):.6g} for {spec.states[i]!r}, this one returns "
            f"{float(following[row, i]):.6g}. Load the state into dynamics with the same physics, "
            "or update new dynamics by its transitions. A physics with random outputs has the same "
            "effect: dynamics need a deterministic one."
        )
