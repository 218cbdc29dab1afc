"""A stand-in for a callable that could not be pickled."""

from __future__ import annotations

from typing import Any, NoReturn

from gpadjust.physics.error import PhysicsError


class LostCallable:
    """Takes the place of a callable that did not fit in a pickle, and says so when called.

    Args:
        owner: The name of the physics.
        attribute: The attribute of the physics that held the callable.

    Example:
        >>> LostCallable("wind tunnel", "function")(0.0)
        Traceback (most recent call last):
        gpadjust.physics.error.PhysicsError: The function of physics 'wind tunnel' ...
    """

    def __init__(self, owner: str, attribute: str) -> None:
        self.owner = owner
        self.attribute = attribute

    def __call__(self, *arguments: Any) -> NoReturn:
        """Raises a ``PhysicsError`` that says how to put the callable back."""
        raise PhysicsError(
            f"The {self.attribute} of physics {self.owner!r} could not be pickled, so this loaded "
            f"copy only knows the rows in its memo; set physics.{self.attribute} = ... again."
        )
