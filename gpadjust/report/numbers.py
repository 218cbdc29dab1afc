"""Numbers and names in words."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from gpadjust.physics import PhysicsError

_UNIT = re.compile(r"(.*\S)\s*\[([^\[\]]*)\]", flags=re.DOTALL)
_SHOWN = 3


def number(value: float, digits: int = 3) -> str:
    """A number with some significant digits, without an exponent where it can be read so."""
    if not math.isfinite(value):
        return "none" if math.isnan(value) else f"{value:g}"
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e7 else text


def percent(share: float) -> str:
    """A share in percent."""
    return f"{100 * share:.0f} %"


def plural(count: int, noun: str) -> str:
    """Such as ``1 row`` and ``2 rows``."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def failure(error: PhysicsError) -> str:
    """What a physics failed at, in a line, with the first inputs at which it did."""
    message = str(error.args[0]).rstrip(": ")
    if error.inputs is None or not len(error.inputs):
        return message
    rows = [f"({', '.join(map(number, row))})" for row in error.inputs[:_SHOWN].tolist()]
    more = len(error.inputs) - len(rows)
    return f"{message.rstrip('.')}: at inputs {listed([*rows, f'{more} more'] if more else rows)}."


def name_and_unit(name: str) -> tuple[str, str]:
    """``"head [m]"`` as ``"head"`` and ``"m"``; no unit where none is in brackets."""
    found = _UNIT.fullmatch(name.strip())
    return (found[1], found[2].strip()) if found else (name, "")


def with_unit(value: str, name: str) -> str:
    """A number and the unit that a name carries."""
    unit = name_and_unit(name)[1]
    return f"{value} {unit}" if unit else value


def listed(items: Iterable[str]) -> str:
    """``a, b and c``."""
    *first, last = items
    return f"{', '.join(first)} and {last}" if first else last
