"""Callables of a physics in a pickle: by name, by value under cloudpickle, or not at all."""

from __future__ import annotations

import copyreg
import pickle
from collections.abc import Callable
from typing import Any

import cloudpickle

from gpadjust.physics.lost_callable import LostCallable

_being_tried: set[int] = set()


class Carrier(type):
    """A class that carries a callable which plain pickle refuses, in ``payload``.

    An object cannot see who pickles it. But cloudpickle takes a class by value, with what is in it,
    before it looks at ``copyreg``, where plain pickle finds ``_not_by_value``.
    """

    payload: tuple[Any]
    owner: str
    attribute: str
    may_be_lost: bool


def pack(value: Any, owner: str, attribute: str, *, may_be_lost: bool) -> Any:
    """What goes into a pickle in place of a callable.

    Args:
        value: The callable.
        owner: The name of the physics that holds it.
        attribute: The attribute that holds it.
        may_be_lost: Whether a ``LostCallable`` may take its place; else plain pickle raises a
            ``PicklingError`` where it cannot take the callable.

    Example:
        >>> pack(len, "count", "function", may_be_lost=False)
        <built-in function len>
        >>> double = pack(lambda x: 2 * x, "double", "function", may_be_lost=False)
        >>> unpack(double)(3)
        6
        >>> pickle.dumps(double)
        Traceback (most recent call last):
        _pickle.PicklingError: The function of physics 'double' cannot be pickled...
    """
    if _can_pickle(value, pickle.dumps):
        return value
    if may_be_lost and not _can_pickle(value, cloudpickle.dumps):
        return LostCallable(owner, attribute)
    content = {"owner": owner, "attribute": attribute, "may_be_lost": may_be_lost}
    return Carrier("Carried", (), {**content, "payload": (value,)})


def unpack(value: Any) -> Any:
    """The callable in a ``Carrier``; anything else as it is."""
    return value.payload[0] if isinstance(value, Carrier) else value


def _not_by_value(carrier: Carrier) -> tuple[Any, ...]:
    if carrier.may_be_lost:
        return LostCallable, (carrier.owner, carrier.attribute)
    raise pickle.PicklingError(
        f"The {carrier.attribute} of physics {carrier.owner!r} cannot be pickled: found "
        f"{carrier.payload[0]!r}, expected a function at the top level of a module. Define it "
        "there, pickle with cloudpickle, or save the state_dict() instead."
    )


copyreg.pickle(Carrier, _not_by_value)


def _can_pickle(value: object, dumps: Callable[[object], bytes]) -> bool:
    if id(value) in _being_tried:  # a callable that holds its physics
        return True
    _being_tried.add(id(value))
    try:
        dumps(value)
    except Exception:
        return False
    finally:
        _being_tried.discard(id(value))
    return True
