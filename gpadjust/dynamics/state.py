"""Saved states of dynamics and their settings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict
from types import FunctionType
from typing import Any

from torch import Tensor

from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec


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
