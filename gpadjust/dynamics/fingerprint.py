"""What dynamics are, said in plain values, so that a state is loaded into none but its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from gpadjust.dynamics.base import Dynamics


def fingerprint(dynamics: Dynamics, **settings: Any) -> dict[str, str]:
    """Class, spec and settings of dynamics, each as a text.

    A setting that is a mapping counts by its items. Modules, functions and other objects that have
    no value to compare are named by their class, classes by their name.
    """
    texts = {"class": type(dynamics).__name__}
    for name, value in {**asdict(dynamics.spec), **settings}.items():
        if isinstance(value, Mapping):
            items = sorted((str(key), _text(part)) for key, part in value.items())
            texts[name] = "{" + ", ".join(f"{key!r}: {part}" for key, part in items) + "}"
        else:
            texts[name] = _text(value)
    return texts


def check_fingerprint(state: dict[str, Any], expected: dict[str, str]) -> None:
    """Raise a RuntimeError, as PyTorch does, if a state is of other dynamics.

    The state of dynamics that learnt nothing is empty, and fits all.

    Raises:
        TypeError: If it is no dictionary.
    """
    if not isinstance(state, Mapping):
        raise TypeError(f"Expected a dictionary that `state_dict` gave, found {state!r}.")
    if not state:
        return
    found = state.get("fingerprint")
    if not isinstance(found, Mapping):
        raise RuntimeError(
            "The state does not say of what dynamics it is; expected one that `state_dict` gave, "
            f"with a 'fingerprint'. It holds {sorted(map(str, state))}."
        )
    names = [name for name in {**expected, **found} if found.get(name) != expected.get(name)]
    if names:
        different = "; ".join(
            f"{name} is {found.get(name, 'missing')} in the state, {expected.get(name, 'missing')} "
            "here"
            for name in names
        )
        raise RuntimeError(
            f"The state is of {found.get('class')} with other settings than this "
            f"{expected['class']}: {different}. Load it into dynamics built as they were."
        )


def _text(value: Any) -> str:
    """The value of plain objects, the class of others."""
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(_text(part) for part in value) + ")"
    if isinstance(value, float):
        return repr(float(value))  # NumPy's print their type
    if value is None or isinstance(value, (bool, int, str)):
        return repr(value)
    return value.__name__ if isinstance(value, type) else f"<{type(value).__name__}>"
