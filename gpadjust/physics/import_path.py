"""A physics by a text: the name under which Python can import it, or its formula."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from importlib import import_module
from operator import attrgetter
from typing import Any

from torch import Tensor

from gpadjust.physics.base import Physics
from gpadjust.physics.formula import FormulaPhysics
from gpadjust.physics.function import FunctionPhysics, as_physics
from gpadjust.physics.unknown import Unknown

_FORMULA = "formula:"


def import_path(physics: Physics | Callable[[Tensor], Tensor]) -> str | None:
    """Return ``"package.module:qualname"`` of a physics, for ``physics_from_path``.

    Of a ``FormulaPhysics`` it is ``"formula:"`` and its arguments. Lambdas and functions inside of
    functions have no name in a module: None. Objects have a path if they are attributes of the
    module of their class or callables; a ``FunctionPhysics`` also the path of its function if it
    has no other settings. A path in ``__main__`` is valid for the same script only.

    Example:
        >>> import_path(physics_from_path), import_path(lambda X: X)
        ('gpadjust.physics.import_path:physics_from_path', None)
    """
    if type(physics) is FormulaPhysics:
        unknowns = {name: asdict(unknown) for name, unknown in physics.unknowns.declared.items()}
        settings = {"formula": physics.formula, "columns": physics.columns, "name": physics.name}
        return f"{_FORMULA}{json.dumps({**settings, 'unknowns': unknowns})}"
    path = _path_of(physics)
    # Settings of a FunctionPhysics would be lost with the path of its function.
    if path or type(physics) is not FunctionPhysics or physics.unknowns or physics.inputs:
        return path
    return _path_of(physics.function)


def is_formula(path: str) -> bool:
    """Return whether a text of ``import_path`` is a formula, which is read and runs nothing."""
    return path.startswith(_FORMULA)


def physics_from_path(path: str) -> Physics:
    """Return the physics that a text of ``import_path`` names, or raise a ValueError.

    Importing a module runs its code, so take paths from files that you trust only. A formula is
    read and runs nothing.
    """
    if is_formula(path):
        try:
            settings = json.loads(path.removeprefix(_FORMULA))
            unknowns = {name: Unknown(**prior) for name, prior in settings["unknowns"].items()}
            return FormulaPhysics(**{**settings, "unknowns": unknowns})  # which checks all of it
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"Found {path!r} as a formula, which is damaged: {error}") from error
    module, _, name = path.partition(":")
    try:
        return as_physics(attrgetter(name)(import_module(module)))
    except Exception as error:  # importing runs the user's code
        raise ValueError(
            f"The physics {path!r} cannot be imported ({type(error).__name__}: {error}). Expected "
            "'package.module:qualname', of a module where Python finds it, or the physics itself."
        ) from error


def _path_of(thing: Any) -> str | None:
    """Return the name of a thing in the module of its class, or of a callable that it contains."""
    owners = [thing]
    if isinstance(thing, Physics):
        owners = [*thing.modules(), *vars(thing).values()]
    for owner in owners:
        module = sys.modules.get(getattr(owner, "__module__", None) or "")
        names = getattr(module, "__dict__", ())
        if hasattr(thing, "__qualname__"):  # of a function or class
            names = [thing.__qualname__]
        for name in names:
            with suppress(AttributeError):
                if attrgetter(name)(module) is thing:
                    return f"{owner.__module__}:{name}"
    return None
