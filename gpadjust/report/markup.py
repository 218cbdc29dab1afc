"""HTML by function calls, balanced and with every text escaped: words, numbers and figures."""

from __future__ import annotations

import math
import re
import warnings
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from io import BytesIO
from typing import Any
from urllib.parse import quote

from matplotlib import rc_context
from matplotlib.figure import Figure

from gpadjust.physics import PhysicsError

_VOID = ("img", "meta", "br")
_UNIT = re.compile(r"(.*\S)\s*\[([^\[\]]*)\]", flags=re.DOTALL)
_SHOWN = 3
_STYLE: dict[str, Any] = {
    "font.size": 9.5,
    "axes.labelsize": 9.5,
    "axes.titlesize": 9.5,
    "axes.linewidth": 0.7,
    "legend.fontsize": 8.5,
    "svg.fonttype": "path",
    "svg.hashsalt": "gpadjust",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}
_LARGE = 70_000  # characters, above which a figure of many points is smaller as pixels
_PLAIN = " <>='/:;,.()!*+@$-_{}\n"  # what a URL between double quotes may have as it is
_NEEDLESS = re.compile(
    r"^.*?(?=<svg )|<!--.*?-->|<metadata>.*?</metadata>|(?<=>)\s+(?=<)|(?<=<g) id=\"[^\"]*\"",
    flags=re.DOTALL,
)
_OF_FONTS = "Glyph .* missing|Matplotlib currently does not support"  # names in any script
_PATH = re.compile(r"\b(?:d|x|y)='[^']*'")
_SPACE = re.compile(r"\s*\n?([MLQCz])\s*")
_BEHIND = re.compile(r"(\.\d\d)\d+")  # hundredths of a point are more than a screen shows


class Markup(str):
    """A text that is HTML already; any other is escaped where it is put into a page."""


def tag(name: str, /, *children: str, **attributes: str) -> Markup:
    """An element.

    Args:
        name: Its name.
        children: Its contents: :class:`Markup` as it is, other texts escaped.
        attributes: Its attributes; ``class_`` is ``class``, and ``aria_label`` ``aria-label``.

    Example:
        >>> tag("p", "a < b, ", tag("em", "c"), class_="note")
        '<p class="note">a &lt; b, <em>c</em></p>'
    """
    named = {key.rstrip("_").replace("_", "-"): value for key, value in attributes.items()}
    start = "".join(f' {key}="{join([value])}"' for key, value in named.items())
    if name in _VOID:
        return Markup(f"<{name}{start}>")
    return Markup(f"<{name}{start}>{join(children)}</{name}>")


def join(children: Iterable[str]) -> Markup:
    """Texts beside one another, without an element around them."""
    return Markup(
        "".join(child if isinstance(child, Markup) else escape(child) for child in children)
    )


def table(
    caption: str,
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    marked: int | None = None,
    kind: str = "numbers",
) -> Markup:
    """A table whose first column names its rows, in a box that scrolls on a narrow screen.

    Args:
        caption: Its title.
        head: The names of its columns.
        rows: Its cells.
        marked: The row that is set off.
        kind: The kind of its cells, ``"numbers"`` or ``"words"``.
    """
    body = []
    for i, (name, *cells) in enumerate(rows):
        mark = {"class_": "marked"} if i == marked else {}
        cells = [tag("td", cell) for cell in cells]
        body.append(tag("tr", tag("th", name, scope="row"), *cells, **mark))
    names = [tag("th", name, scope="col") for name in head]
    whole = tag(
        "table",
        tag("caption", caption),
        tag("thead", tag("tr", *names)),
        tag("tbody", *body),
        class_=kind,
    )
    return tag("div", whole, class_="scroll", tabindex="0", role="region", aria_label=caption)


def bullets(items: Iterable[str]) -> Markup:
    """A list."""
    return tag("ul", *(tag("li", item) for item in items))


def document(
    title: str, lead: str, question: str, answer: Markup, sections: Mapping[str, Markup]
) -> str:
    """A page of HTML that needs nothing else.

    Args:
        title: The title.
        lead: A sentence below it.
        question: The heading of the first part.
        answer: The first part, before the links to all others.
        sections: The other parts by their headings.
    """
    links = [tag("a", name, href=f"#{_anchor(name)}") for name in sections]
    body = [
        tag("section", tag("h2", name), text, id=_anchor(name)) for name, text in sections.items()
    ]
    main = tag(
        "main",
        tag("header", tag("h1", title), tag("p", lead, class_="lead")),
        tag("h2", question, class_="first"),
        answer,
        tag("nav", bullets(links), aria_label="Sections"),
        *body,
    )
    style = Markup(files("gpadjust.report").joinpath("style.css").read_text(encoding="utf-8"))
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("title", title),
        tag("style", style),
    )
    return join([Markup("<!DOCTYPE html>\n"), tag("html", head, tag("body", main), lang="en")])


def code(text: str) -> Markup:
    """A block of code."""
    return tag("div", tag("pre", tag("code", text)), class_="scroll", tabindex="0")


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
    """The failure of a physics in a line, with the first inputs at which it fails."""
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


def with_unit(value: str, name: str, form: str = "{} {}") -> str:
    """A number, or words, and the unit that a name carries; as they are if it carries none."""
    unit = name_and_unit(name)[1]
    return form.format(value, unit) if unit not in ("", "1") else value


def listed(items: Iterable[str]) -> str:
    """``a, b and c``."""
    *first, last = items
    return f"{', '.join(first)} and {last}" if first else last


def drawn(draw: Callable[[], list[Markup]]) -> Markup:
    """Figures side by side, or why there are none: a physics may fail where there are no data."""
    try:
        with rc_context(_STYLE), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=_OF_FONTS)
            images = draw()
    except PhysicsError as error:
        return tag("p", f"No figure: {failure(error)}", class_="caution")
    if not images:
        return Markup()
    return tag("div", *(tag("figure", image) for image in images), class_="figures")


def image(figure: Figure, alt: str) -> Markup:
    """A figure as an image in the page: as curves, or many points as pixels."""
    source = _curves(figure)
    if len(source) > _LARGE:
        buffer = BytesIO()
        figure.savefig(buffer, format="png", dpi=180)
        raster = f"data:image/png;base64,{b64encode(buffer.getvalue()).decode()}"
        source = min(source, raster, key=len)
    width, height = (str(round(96 * size)) for size in figure.get_size_inches())
    return tag("img", src=Markup(source), alt=alt, width=width, height=height)


def _anchor(name: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in name.lower()).strip("-")


def _curves(figure: Figure) -> str:
    """A figure as SVG, without what a page does not need."""
    buffer = BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = _NEEDLESS.sub("", buffer.getvalue().decode()).replace('"', "'")
    text = _PATH.sub(lambda path: _SPACE.sub(r"\1", _BEHIND.sub(r"\1", path[0])), text)
    return f"data:image/svg+xml,{quote(text, safe=_PLAIN)}"
