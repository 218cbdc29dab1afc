"""Names on their way out: from one version on they warn, from another they are gone."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import gpadjust

_Given = ParamSpec("_Given")
_Returned = TypeVar("_Returned")


def deprecated(
    since: str, until: str, instead: str
) -> Callable[[Callable[_Given, _Returned]], Callable[_Given, _Returned]]:
    """Decorate a function or method, or a class's ``__init__``, whose calls then warn.

    Args:
        since: The first version that warns.
        until: The first version without it, two minor versions later or more.
        instead: What to use in its place.

    Returns:
        The decorator.

    Raises:
        ValueError: If ``until`` is too early, or has come: the code is to be removed.

    Warns:
        FutureWarning: At each call, which names both versions and the replacement.

    Example:
        >>> @deprecated(since="0.2", until="99.0", instead="abs")
        ... def size(x):
        ...     return abs(x)
        >>> with warnings.catch_warnings(record=True, action="always") as heard:
        ...     size(-2)
        2
        >>> print(heard[0].message)
        size is deprecated since gpadjust 0.2 and gone in 99.0; use abs.
    """
    first, last = _numbers(since), _numbers(until)
    if last < (first[0], first[1] + 2) and last[0] == first[0]:
        raise ValueError(f"What {since} deprecates stays for two minor versions; found {until}.")
    if last <= _numbers(gpadjust.__version__):
        raise ValueError(f"What was to be gone in {until} is to be removed now.")

    def decorate(called: Callable[_Given, _Returned]) -> Callable[_Given, _Returned]:
        name = called.__qualname__.removesuffix(".__init__")

        @wraps(called)
        def warned(*args: _Given.args, **kwargs: _Given.kwargs) -> _Returned:
            warnings.warn(
                f"{name} is deprecated since gpadjust {since} and gone in {until}; use {instead}.",
                FutureWarning,
                stacklevel=2,
            )
            return called(*args, **kwargs)

        return warned

    return decorate


def _numbers(version: str) -> tuple[int, ...]:
    """The first two numbers of a version, to be compared: 0.10.1 comes after 0.9."""
    major, minor, *_ = re.findall(r"\d+", version)
    return int(major), int(minor)
