"""Fields of a table, which are texts: numbers, missing values, dates, and names with units."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from unicodedata import normalize

_BEGINNING = datetime(2000, 1, 1, tzinfo=UTC)
MISSING = {"", "na", "n/a", "#n/a", "#nv", "nan", "null", "none", "?"}
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
    kg mg t l ml j kj mol ppm db ohm \u03c9 lux""".split()  # noqa: SIM905
)


def number(text: str, decimal: str = ".", *, grouped: bool = False) -> float:
    """Return the number of a field: NaN if it is missing, infinity if it is none.

    Thousands may be apart by blanks or apostrophes; by the other mark, a point or comma, where the
    decimal mark is there too, or if they are known to be ``grouped``.
    """
    if text.lower() in MISSING or not text.strip("-"):
        return math.nan
    text = text.replace("\u2212", "-")
    match = _GROUPED.fullmatch(text)
    mark = match[1] if match else decimal
    if mark != decimal and (grouped or mark not in ".," or decimal in text or text.count(mark) > 1):
        text = text.replace(mark, "")
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
    """Return whether a field is empty, or says that nothing was measured."""
    return math.isnan(number(text))


def decimal_of(fields: Sequence[str], delimiter: str) -> tuple[str, bool]:
    """Return the decimal mark of a table's numbers, and whether the other one parts thousands.

    Where 1,234 may be either it is a point, and thousands are not parted.
    """
    commas = [text for text in fields if "," in text and is_number(text)]
    both = [text for text in commas if "." in text]
    if both:  # 1,234.5 or 1.234,5
        return max(".,", key=both[0].rfind), True
    may_part = (_GROUPED.fullmatch(text) and text.lstrip("+-")[0] != "0" for text in commas)
    return (",", False) if commas and (delimiter == ";" or not all(may_part)) else (".", False)


def is_moment(text: str) -> bool:
    """Return whether a field is a date, a time of day, or both."""
    return any(_moment(text, day_first) is not None for day_first in (True, False))


def seconds_of(texts: Sequence[str]) -> list[float]:
    """Return dates and times of day as seconds since the first.

    Dates are as of ISO 8601, ``2015-02-02 14:19:00``, or with points, ``2.2.2015 14:19``; with
    strokes, too, if they are days before months, or months before days, in all rows or none.

    Raises:
        ValueError: If one is none, or they may be read in two ways.
    """
    readings: list[list[float]] = []
    for day_first in (True, False):
        moments = [_moment(text.strip(), day_first) for text in texts]
        known = [moment for moment in moments if moment is not None]
        if len(known) < len(moments) or len({kind for kind, _ in known}) > 1:
            continue
        seconds = [(since - known[0][1]).total_seconds() for _, since in known]
        if seconds not in readings:
            readings.append(seconds)
    if len(readings) == 1:
        return readings[0]
    if readings:
        raise ValueError(
            f"expected dates in one way, found {texts[0]!r}, whose day and month may be either; "
            "write dates as 2015-02-28"
        )
    found = next((text for text in texts if not is_moment(text.strip())), texts[0])
    raise ValueError(
        "expected all as dates such as 2015-02-28 14:19:00, or all as times such as 14:19:00, "
        f"found {found!r}"
    )


def _moment(text: str, day_first: bool) -> tuple[str, timedelta] | None:
    """Return the kind of a moment and its time since some beginning; None of another text."""
    match = _MOMENT.fullmatch(text)
    if not text or match is None:
        return None
    year, month, day, first, mark, second, last = match.groups()[:7]
    hour, minute, of_minute, half, zone = match.groups()[7:]
    if first is not None:
        if len(last) == 2 and mark != ".":
            return None
        day, month = (first, second) if day_first or mark == "." else (second, first)
        year = last if len(last) == 4 else f"20{last}"
    clock = timedelta()
    if hour is not None:
        hours = int(hour) % 12 + 12 * (half.lower() == "pm") if half else int(hour)
        seconds = float((of_minute or "0").replace(",", "."))
        clock = timedelta(hours=hours, minutes=int(minute), seconds=seconds)
    if year is None:
        return None if of_minute is None else ("clock", clock)  # 01:30 may be minutes
    try:
        date = datetime.fromisoformat(f"{year}-{month:0>2}-{day:0>2}T00:00:00{zone or '+00:00'}")
    except ValueError:
        return None
    return "date" if zone is None else "zoned", date - _BEGINNING + clock


def split_unit(name: str) -> tuple[str, str]:
    """Return ``"head"`` and ``"m"`` of ``"head [m]"`` or ``"head (m)"``; no unit if there is none.

    Example:
        >>> split_unit("Servo 3 (us)"), split_unit("head")
        (('Servo 3', 'us'), ('head', ''))
    """
    match = _NAME.fullmatch(name.strip())
    return (match[1], (match[2] or match[3] or "").strip()) if match else (name, "")


def is_unit(text: str) -> bool:
    """Return whether a field is a unit, in brackets or of common ones, such as ``m/s``."""
    if text[:1] + text[-1:] in ("[]", "()"):
        return True
    parts = re.split(r"[\s*/·^\d().-]+", normalize("NFKC", text).casefold())
    return all(part in _COMMON_UNITS for part in parts if part)


def seconds_in(unit: str) -> float | None:
    """Return the seconds in a unit of time; None of another unit."""
    return _SECONDS.get(normalize("NFKC", unit).casefold())


def time_unit_of(name: str) -> str:
    """Return the unit of time that a name is or ends with, as ``time_ms`` or ``millis``, or ""."""
    last = re.split(r"[\s_.-]+", name.strip())[-1]
    return last if seconds_in(last) is not None else ""
