"""Numbers, names and units in sentences."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from torch import Tensor

_UNIT = re.compile(r"(.*\S)\s*\[([^\[\]]*)\]", flags=re.DOTALL)


def number(value: float | Tensor, digits: int = 3) -> str:
    """Return a number with some significant digits, without an exponent where that is readable."""
    value = float(value)
    if not math.isfinite(value):
        return "none" if math.isnan(value) else f"{value:g}"
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e7 else text


def percent(share: float | Tensor) -> str:
    """Return a share in percent."""
    return f"{100 * float(share):.0f} %"


def plural(count: int, noun: str) -> str:
    """Return such as ``1 row`` and ``2 rows``."""
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def listed(items: Iterable[str]) -> str:
    """Return ``a, b and c``."""
    *first, last = [*items] or [""]
    return f"{', '.join(first)} and {last}" if first else last


def name_and_unit(name: str) -> tuple[str, str]:
    """Return ``"head"`` and ``"m"`` of ``"head [m]"``; no unit where none is in brackets."""
    match = _UNIT.fullmatch(name.strip())
    return (match[1], match[2].strip()) if match else (name, "")


def bare(name: str) -> str:
    """Return a name without its unit."""
    return name_and_unit(name)[0]


def with_unit(value: str, name: str, form: str = "{} {}") -> str:
    """Return a number, or words, with the unit of a name; as they are if it has none, or 1."""
    unit = name_and_unit(name)[1]
    return form.format(value, unit) if unit not in ("", "1") else value
