"""HTML by function calls, balanced and with every text escaped: words, numbers and figures."""

from __future__ import annotations

import re
import warnings
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from html import escape
from importlib.resources import files
from io import BytesIO
from typing import Any, NamedTuple, ParamSpec

from matplotlib import rc_context
from matplotlib.figure import Figure

from gpadjust.physics import PhysicsError, PhysicsParameters
from gpadjust.words import listed, number, shortened

P = ParamSpec("P")
_VOID = ("img", "meta")  # elements without an end
_SHOWN = 3  # inputs at which a physics fails
_WIDTH = 3.6  # inches: as wide as a column of the page, so that text has its size
_DPI = 160  # sharp on paper, too
_STYLE: dict[str, Any] = {
    **dict.fromkeys(("font.size", "axes.labelsize", "axes.titlesize"), 9.5),
    **dict.fromkeys(("figure.facecolor", "savefig.facecolor"), "white"),
    **{"axes.linewidth": 0.7, "legend.fontsize": 8.5},
}
_OF_FONTS = "Glyph .* missing|Matplotlib currently does not support"  # names in any script


class Markup(str):
    """A text that is HTML already; any other is escaped where it is put into a page."""


class Card(NamedTuple):
    """The answer for an output."""

    name: str
    errors: Mapping[str, str]  # with their unit
    note: str  # on the errors
    answer: str
    reasons: list[str]
    color: str = "open"  # or "yes" or "no"
    picture: Markup = Markup()


class Page(NamedTuple):
    """A page: a question with its answers, sections by their headings, settings by their names."""

    title: str
    lead: str
    question: str
    cards: list[Card]
    headline: str  # for the terminal
    sections: Mapping[str, Markup]
    settings: dict[str, str]


def tag(name: str, /, *children: str, **attributes: str) -> Markup:
    """Return an element; children that are no :class:`Markup` are escaped.

    Attributes are keywords: ``class_`` is ``class``, and ``aria_label`` ``aria-label``.

    Example:
        >>> tag("p", "a < b, ", tag("em", "c"), class_="note")
        '<p class="note">a &lt; b, <em>c</em></p>'
    """
    # Python's keywords have an underscore behind them, and names none of HTML's hyphens.
    named = {key.rstrip("_").replace("_", "-"): value for key, value in attributes.items()}
    start = "".join(f' {key}="{join([value])}"' for key, value in named.items())
    if name in _VOID:
        return Markup(f"<{name}{start}>")
    return Markup(f"<{name}{start}>{join(children)}</{name}>")


def join(children: Iterable[str]) -> Markup:
    """Return texts one after the other, escaped, without an element around them."""
    return Markup("".join(c if isinstance(c, Markup) else escape(c) for c in children))


def bullets(items: Iterable[str]) -> Markup:
    """Return a list; nothing if there are no items."""
    elements = [tag("li", item) for item in items]
    return tag("ul", *elements) if elements else Markup()


def code(text: str) -> Markup:
    """Return a block of code; nothing if it is empty."""
    if not text:
        return Markup()
    return tag("div", tag("pre", tag("code", text)), class_="scroll", tabindex="0")


def table(
    caption: str,
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    marked: int | None = None,
    kind: str = "numbers",
) -> Markup:
    """Return a table whose first column names its rows, in a box that scrolls on narrow screens.

    The row ``marked`` is set off; ``kind`` of the cells is ``"numbers"`` or ``"words"``.
    """
    lines = []
    for i, (name, *cells) in enumerate(rows):
        mark = {"class_": "marked"} if i == marked else {}
        columns = [tag("td", cell) for cell in cells]
        lines.append(tag("tr", tag("th", name, scope="row"), *columns, **mark))
    names = tag("tr", *(tag("th", name, scope="col") for name in head))
    parts = [tag("caption", caption), tag("thead", names), tag("tbody", *lines)]
    element = tag("table", *parts, class_=kind)
    return tag("div", element, class_="scroll", tabindex="0", role="region", aria_label=caption)


def parameter_table(caption: str, parameters: PhysicsParameters) -> Markup:
    """Return a table of unknown parameters: their posterior and prior."""
    low, high = parameters.interval()
    rows = []
    for i, (name, unknown) in enumerate(parameters.unknowns.items()):
        spread = ["-", "-"]  # sd and interval
        if parameters.sd[i] > 0:  # not of a point fit
            interval = f"{number(low[i], 4)} to {number(high[i], 4)}"
            spread = [number(parameters.sd[i]), interval]
        value = number(parameters.center[i], 4)
        rows.append([name, value, *spread, unknown.prior_text, unknown.unit or "-"])
    head = ["parameter", "value", "sd", "95 % interval", "prior", "unit"]
    return table(caption, head, rows)


def side_by_side(cards: Sequence[Card]) -> Markup:
    """Return the answer on each output, its reasons, its errors in large numbers, its picture."""
    shown = []
    for card in cards:
        parts = [tag("p", card.answer, class_="answer")]
        if len(cards) > 1:
            parts.insert(0, tag("h3", card.name))
        parts += [tag("p", reason.replace("+-", "±")) for reason in card.reasons]
        numbers = [tag("div", tag("dt", n), tag("dd", value)) for n, value in card.errors.items()]
        parts += [tag("dl", *numbers, class_="errors"), tag("p", card.note, class_="note")]
        shown.append(tag("div", *parts, card.picture, class_=f"card {card.color}"))
    return tag("div", *shown, class_="cards")


def document(page: Page) -> Markup:
    """Return a page of HTML that needs nothing else; sections without text are left out."""
    sections = {name: text for name, text in page.sections.items() if text}
    settings = [[name, value] for name, value in page.settings.items()]
    caption = "How this page came about"
    sections["Settings"] = table(caption, ["setting", "value"], settings, kind="words")
    # Links within the page have an id for each section.
    ids = {name: re.sub(r"\W", "-", name.lower()).strip("-") for name in sections}
    main = tag(
        "main",
        tag("header", tag("h1", page.title), tag("p", page.lead, class_="lead")),
        tag("h2", page.question, class_="first"),
        side_by_side(page.cards),
        tag("nav", bullets(tag("a", n, href=f"#{ids[n]}") for n in ids), aria_label="Sections"),
        *(tag("section", tag("h2", n), text, id=ids[n]) for n, text in sections.items()),
    )
    style = Markup(files("gpadjust.report").joinpath("style.css").read_text(encoding="utf-8"))
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("title", page.title),
        tag("style", style),
    )
    return join([Markup("<!DOCTYPE html>\n"), tag("html", head, tag("body", main), lang="en")])


def failure(error: PhysicsError) -> str:
    """Return the failure of a physics in a line, with the first of its inputs."""
    message = str(error.args[0]).rstrip(": ")
    if error.inputs is None or not len(error.inputs):  # the call failed as a whole
        return message
    rows = [f"({', '.join(map(number, row))})" for row in error.inputs.tolist()]
    return f"{message.rstrip('.')}: at inputs {listed(shortened(rows, _SHOWN))}."


def drawn(draw: Callable[P, list[Markup]]) -> Callable[P, Markup]:
    """Return a function of figures side by side, or of the failure of a physics instead."""

    @wraps(draw)
    def figures(*args: P.args, **options: P.kwargs) -> Markup:
        try:
            with rc_context(_STYLE), warnings.catch_warnings():  # the user's settings stay
                warnings.filterwarnings("ignore", message=_OF_FONTS)
                images = [tag("figure", image) for image in draw(*args, **options)]
        except PhysicsError as error:
            return tag("p", f"No figure: {failure(error)}", class_="caution")
        return tag("div", *images, class_="figures") if images else Markup()

    return figures


def new_figure(height: float) -> Figure:
    """Return an empty figure as wide as a column of the page, of a height in inches."""
    return Figure(figsize=(_WIDTH, height), layout="constrained")


def image(figure: Figure, alt: str) -> Markup:
    """Return a figure as an image in the page."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    source = f"data:image/png;base64,{b64encode(buffer.getvalue()).decode()}"
    width, height = (str(round(96 * size)) for size in figure.get_size_inches())  # CSS's pixels
    return tag("img", src=source, alt=alt, width=width, height=height)
