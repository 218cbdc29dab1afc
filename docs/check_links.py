"""Check a built site: python docs/check_links.py docs/_build.

Each link inside it leads to a file and an anchor, and nothing is loaded from another host.
"""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"script", "link", "img", "iframe", "source", "video", "audio", "embed", "object"}


class Page(HTMLParser):
    """The anchors of a page, and what it links to."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[tuple[str, str]] = []
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an element is called, and what it leads to."""
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            elif name in ("href", "src", "data") and value:
                self.links.append((tag, value))


def problems(site: Path) -> list[str]:
    """Return what is wrong with the pages and styles of a site."""
    pages = {path.resolve(): Page(path) for path in sorted(site.rglob("*.html"))}
    found, links = [], 0
    for path, page in pages.items():
        for tag, link in page.links:
            parts = urlsplit(link)
            if parts.scheme == "data":
                continue
            if parts.scheme or parts.netloc:
                if tag in LOADED:
                    found.append(f"{path.name} loads {link}")
                continue
            links += 1
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file():
                found.append(f"{path.name} links to {link}, which does not exist")
                continue
            anchors = pages[target].anchors if target in pages else set()
            if target in pages and parts.fragment and unquote(parts.fragment) not in anchors:
                found.append(f"{path.name} links to {link}, which has no such anchor")
    elsewhere = r"""(?:url\(|@import)\s*["']?((?:https?:)?//[^"')]+)"""
    for path in site.rglob("*.css"):
        loaded = re.findall(elsewhere, path.read_text())
        found += [f"{path.name} loads {link}" for link in loaded]
    print(f"{len(pages)} pages, {links} internal links: {len(found)} problems")
    return found


if __name__ == "__main__":
    sys.exit("\n".join(problems(Path(sys.argv[1]))) or None)
