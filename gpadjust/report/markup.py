"""HTML by function calls: balanced, and with every text escaped."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

_VOID = ("img", "meta", "br")


class Markup(str):
    """A text that is HTML already; any other is escaped where it is put into a page."""


def tag(name: str, /, *children: str, **attributes: str) -> Markup:
    """An element.

    Args:
        name: Its name.
        children: What it holds: :class:`Markup` as it is, other texts escaped.
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
    """What is beside one another, without an element around it."""
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
        caption: What it shows.
        head: The names of its columns.
        rows: Its cells.
        marked: The row that is set off.
        kind: What is in its cells, ``"numbers"`` or ``"words"``.
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


def code(text: str) -> Markup:
    """A block of code."""
    return tag("div", tag("pre", tag("code", text)), class_="scroll", tabindex="0")
