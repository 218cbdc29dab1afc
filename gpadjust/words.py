"""Numbers, names and units in sentences."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence, Sized

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


def noun_for(count: int, noun: str) -> str:
    """Return a noun as it follows a count: ``row`` or ``rows``."""
    if count == 1:
        return noun
    return f"{noun}s"


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, such as ``1 row`` or ``2 rows``."""
    return f"{count:,} {noun_for(count, noun)}"


def listed(items: Iterable[str]) -> str:
    """Return items as a text, such as ``a, b and c``."""
    *first, last = [*items] or [""]
    if not first:
        return last
    return f"{', '.join(first)} and {last}"


def shortened(items: Sequence[str], most: int) -> list[str]:
    """Return the first of some items, and how many more there are."""
    if len(items) <= most:
        return [*items]
    return [*items[:most], f"{len(items) - most} more"]


def noted(text: str, note: str) -> str:
    """Return a text with a note in brackets, such as ``line 3 (outlier)``; alone without a note."""
    return f"{text} ({note})" if note else text


def name_among(name: str, names: Sized) -> str:
    """Return a name; empty if it is the only one, which needs none."""
    return name if len(names) > 1 else ""


def about(subjects: Iterable[str], text: str) -> str:
    """Return a text behind the names of its subjects, such as ``head: too low``, but empty ones."""
    return ": ".join([*filter(None, subjects), text])


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
