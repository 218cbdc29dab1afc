"""Figures as images that are part of the page."""

from __future__ import annotations

import re
import warnings
from base64 import b64encode
from collections.abc import Callable
from io import BytesIO
from typing import Any
from urllib.parse import quote

from matplotlib import rc_context
from matplotlib.figure import Figure

from gpadjust.physics import PhysicsError
from gpadjust.report.markup import Markup, tag
from gpadjust.report.numbers import failure

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


def image(figure: Figure, alt: str, *, pixels: bool = False) -> Markup:
    """A figure as an image in the page: as curves, or many points or areas as pixels."""
    source = "" if pixels else _curves(figure)
    if pixels or len(source) > _LARGE:
        buffer = BytesIO()
        figure.savefig(buffer, format="png", dpi=180)
        raster = f"data:image/png;base64,{b64encode(buffer.getvalue()).decode()}"
        source = min(source or raster, raster, key=len)
    width, height = (str(round(96 * size)) for size in figure.get_size_inches())
    return tag("img", src=Markup(source), alt=alt, width=width, height=height)


def _curves(figure: Figure) -> str:
    """A figure as SVG, without what a page does not need."""
    buffer = BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = _NEEDLESS.sub("", buffer.getvalue().decode()).replace('"', "'")
    text = _PATH.sub(lambda path: _SPACE.sub(r"\1", _BEHIND.sub(r"\1", path[0])), text)
    return f"data:image/svg+xml,{quote(text, safe=_PLAIN)}"
