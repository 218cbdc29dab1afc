"""Fields of a table, which are texts: numbers, missing values, dates, and names with units."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from unicodedata import normalize

_BEGINNING = datetime(2000, 1, 1, tzinfo=UTC)
MISSING = {
    *("", "na", "n/a", "#n/a", "#nv", "nan", "null", "none", "?"),
    *("#div/0!", "#value!", "#wert!", "#ref!", "#bezug!", "#name?", "#num!", "#zahl!", "#null!"),
}  # the second line: errors of spreadsheets
_GROUPED = re.compile(r"[+-]?\d{1,3}(?:([ \xa0\u202f'\u2019.,])\d{3})(?:\1\d{3})*(?:[.,]\d+)?")
_NAME = re.compile(r"(.*\S)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))", flags=re.DOTALL)
_MOMENT = re.compile(
    r"(?:(\d{4})[-/.](\d\d?)[-/.](\d\d?)|(\d\d?)([-/.])(\d\d?)\5(\d{4}|\d\d))?"
    r"(?:(?:^|[T\s,]\s*)(\d+):(\d\d)(?::(\d\d(?:[.,]\d+)?))?\s*([ap]m)?\s*(Z|[+-]\d\d:?\d\d)?)?",
    flags=re.IGNORECASE,
)
_SECONDS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "\u03bcs", "usec", "micros", "microseconds"), 1e-6),  # a Greek mu
    **dict.fromkeys(("ns", "nsec", "nanoseconds"), 1e-9),
    **dict.fromkeys(("min", "mins", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), 86400.0),
}
_COMMON_UNITS = frozenset(
    """s sec ms us \u03bcs ns min h hr d m mm cm km um \u03bcm nm in ft n kn mn pa kpa mpa gpa hpa
    bar mbar psi k c f \u00b0c \u00b0f degc v mv kv a ma w kw mw hz khz mhz rpm rad deg \u00b0 % g
    kg mg t l ml j kj mol ppm db ohm \u03c9 lux ncm nmm knm knmm wh kwh ws ah mah va kva""".split()  # noqa: SIM905
)


def number(text: str, decimal: str = ".", *, grouped: bool = False) -> float:
    """Return the number in a field: NaN if it is missing, infinity if the field is not a number.

    A point or comma separates thousands where the field has the other mark, or if ``grouped``.
    """
    if text.lower() in MISSING or not text.strip("-"):
        return math.nan
    text = text.replace("\u2212", "-")  # the minus sign of word processors
    match = _GROUPED.fullmatch(text)
    if match and match[1] != decimal:
        separator = match[1]
        # One point or comma alone may be a decimal mark.
        is_clear = separator not in ".," or decimal in text or text.count(separator) > 1
        if grouped or is_clear:
            text = text.replace(separator, "")
    if "_" in text or (decimal != "." and "." in text):
        return math.inf  # Python would take 1_000, and 1.000 may be a thousand there
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return math.inf


def is_number(text: str) -> bool:
    """Return whether a field is a finite number with either decimal mark."""
    return any(math.isfinite(number(text, decimal, grouped=True)) for decimal in ".,")


def is_missing(text: str) -> bool:
    """Return whether a field is empty or has a word for a missing value."""
    return math.isnan(number(text))


def decimal_of(fields: Sequence[str], delimiter: str) -> tuple[str, bool]:
    """Return the decimal mark of a table, and whether the other mark separates thousands.

    If 1,234 is ambiguous in the table, the decimal mark is a point and thousands have no mark.
    """
    commas = [text for text in fields if "," in text and is_number(text)]
    both = [text for text in commas if "." in text]
    if both:  # 1,234.5 or 1.234,5
        return max(".,", key=both[0].rfind), True
    # 0,123 and 12,34 cannot be thousands; a semicolon parts the fields of decimal commas.
    if commas and (delimiter == ";" or not all(map(_has_thousands, commas))):
        # 70.000 beside 2,66: all points may separate thousands.
        points = [text for text in fields if "." in text and is_number(text)]
        return ",", bool(points) and all(map(_has_thousands, points))
    return ".", False


def _has_thousands(text: str) -> bool:
    """Return whether marks of a number may separate thousands, as in 1,234, but not in 0,123."""
    return bool(_GROUPED.fullmatch(text)) and text.lstrip("+-")[0] != "0"


def is_moment(text: str) -> bool:
    """Return whether a field is a date, a time of day, or both."""
    return any(_moment(text, day_first) is not None for day_first in (True, False))


def seconds_of(texts: Sequence[str]) -> list[float]:
    """Return dates and times of day as seconds since the first.

    Dates follow ISO 8601, ``2015-02-02 14:19:00``, or have points, ``2.2.2015 14:19``. Raise a
    ValueError if a text is not a date, or the order of day and month is ambiguous.
    """
    readings: list[list[float]] = []
    for day_first in (True, False):
        moments = [_moment(text.strip(), day_first) for text in texts]
        parsed = [moment for moment in moments if moment is not None]
        # All rows must be of one kind: a clock time has no date to subtract.
        if len(parsed) < len(moments) or len({kind for kind, _ in parsed}) > 1:
            continue
        seconds = [(since - parsed[0][1]).total_seconds() for _, since in parsed]
        if seconds not in readings:
            readings.append(seconds)
    if len(readings) == 1:
        return readings[0]
    if readings:
        raise ValueError(
            f"expected unambiguous dates, found {texts[0]!r}, whose day and month may be swapped; "
            "write dates as 2015-02-28"
        )
    wrong = next((text for text in texts if not is_moment(text.strip())), texts[0])
    raise ValueError(
        "expected only dates such as 2015-02-28 14:19:00, or only times such as 14:19:00, "
        f"found {wrong!r}"
    )


def _moment(text: str, day_first: bool) -> tuple[str, timedelta] | None:
    """Return the kind of a moment and its time since a fixed date; None for any other text."""
    match = _MOMENT.fullmatch(text)
    if not text or match is None:
        return None
    year, month, day, first, mark, second, last = match.groups()[:7]
    hour, minute, clock_second, half, zone = match.groups()[7:]
    if first is not None:
        if len(last) == 2 and mark != ".":
            return None  # 1/2/03 may begin with any of the three
        day, month = second, first
        if day_first or mark == ".":
            day, month = first, second
        year = f"20{last}"[-4:]
    clock = timedelta()
    if hour is not None:
        hours = int(hour)
        if half:  # 12 am is hour 0, 12 pm is hour 12
            hours %= 12
            if half.lower() == "pm":
                hours += 12
        seconds = float((clock_second or "0").replace(",", "."))
        clock = timedelta(hours=hours, minutes=int(minute), seconds=seconds)
    if year is None and clock_second is None:
        return None  # 01:30 may be minutes
    if year is None:
        return "clock", clock
    try:
        date = datetime.fromisoformat(f"{year}-{month:0>2}-{day:0>2}T00:00:00{zone or '+00:00'}")
    except ValueError:
        return None
    kind = "zoned" if zone else "date"
    return kind, date - _BEGINNING + clock


def split_unit(name: str) -> tuple[str, str]:
    """Return ``"head"`` and ``"m"`` of ``"head [m]"`` or ``"head (m)"``; ``""`` without a unit."""
    match = _NAME.fullmatch(name.strip())
    if not match:
        return name, ""
    return match[1], (match[2] or match[3] or "").strip()


def is_unit(text: str) -> bool:
    """Return whether a field is a unit: in brackets, or made of common units, such as ``m/s``."""
    if text[:1] + text[-1:] in ("[]", "()"):
        return True
    # "m/s^2" has the parts m and s.
    parts = re.split(r"[\s*/·^\d().-]+", normalize("NFKC", text).casefold())
    return all(part in _COMMON_UNITS for part in parts if part)


def seconds_in(unit: str) -> float | None:
    """Return the seconds in a unit of time; None for any other unit."""
    return _SECONDS.get(normalize("NFKC", unit).casefold())


def time_unit_of(name: str) -> str:
    """Return the unit of time at the end of a name, as in ``time_ms`` or ``millis``, or ""."""
    last = re.split(r"[\s_.-]+", name.strip())[-1]
    if seconds_in(last) is None:
        return ""
    return last
