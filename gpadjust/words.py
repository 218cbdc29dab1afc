"""Numbers, names and units in sentences."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from torch import Tensor

_UNIT = re.compile(r"(.*\S)\s*\[([^\[\]]*)\]", flags=re.DOTALL)


def number(value: float | Tensor, digits: int = 3) -> str:
    """Return a number with ``digits`` significant digits, below 1e7 without an exponent."""
    value = float(value)
    if math.isnan(value):
        return "none"
    text = f"{value:.{digits}g}"
    if "e+" in text and abs(value) < 1e7:  # 12,300 rather than 1.23e+04
        return f"{float(text):.0f}"
    return text


def percent(share: float | Tensor) -> str:
    """Return a share in percent."""
    return f"{100 * float(share):.0f} %"


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, such as ``1 row`` or ``2 rows``."""
    return f"{count:,} {noun}" + "s" * (count != 1)


def listed(items: Iterable[str]) -> str:
    """Return items as a text, such as ``a, b and c``."""
    *first, last = [*items] or [""]
    return " and ".join([", ".join(first)] * bool(first) + [last])


def name_and_unit(name: str) -> tuple[str, str]:
    """Return ``"head"`` and ``"m"`` of ``"head [m]"``; ``""`` without a unit in brackets."""
    match = _UNIT.fullmatch(name.strip())
    if not match:
        return name, ""
    return match[1], match[2].strip()


def labelled(name: str, unit: str) -> str:
    """Return a name with its unit, such as ``head [m]``; the name alone if it has none."""
    return f"{name} [{unit}]" if unit else name


def bare(name: str) -> str:
    """Return a name without its unit."""
    return name_and_unit(name)[0]


def with_unit(value: str, name: str, form: str = "{} {}") -> str:
    """Return a value in the unit of a name; the value alone if the unit is missing or 1."""
    unit = name_and_unit(name)[1]
    if unit in ("", "1"):
        return value
    return form.format(value, unit)
