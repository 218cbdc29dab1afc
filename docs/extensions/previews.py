"""Description and picture of each page, for search engines and for previews of links."""

from html import escape
from typing import Any

from docutils.nodes import Node, document, emphasis, image, paragraph, section
from sphinx.application import Sphinx

LONGEST = 200  # characters of a description


def describe(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: document | None
) -> None:
    """Add the tags of a page: of its first paragraph, and of its first picture."""
    if doctree is None:
        return
    texts = [each.astext() for each in doctree.findall(paragraph) if is_text(each)]
    title = app.env.titles[page].astext()
    text = " ".join((texts or [title])[0].split())
    if len(text) > LONGEST:
        text = text[:LONGEST].rsplit(" ", 1)[0] + " ..."
    tags = {"og:type": "website", "og:site_name": app.config.project, "og:title": title}
    tags["og:description"] = text
    pictures = [each["uri"] for each in doctree.findall(image) if "://" not in each["uri"]]
    if app.config.html_baseurl and pictures:  # an address as a whole is asked for
        name = app.builder.images.get(pictures[0], "")
        tags["og:image"] = f"{app.config.html_baseurl.rstrip('/')}/_images/{name}"
    context["metatags"] += f'\n<meta name="description" content="{escape(text)}" />'
    for name, value in tags.items():
        context["metatags"] += f'\n<meta property="{name}" content="{escape(value)}" />'


def is_text(node: Node) -> bool:
    """Return whether a paragraph is running text, no cell of a table nor, in italics, a caption."""
    running = isinstance(node.parent, section) and node.astext()
    return bool(running) and not isinstance(node.children[0], image | emphasis)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the hook."""
    app.connect("html-page-context", describe)
    return {"parallel_read_safe": True}
