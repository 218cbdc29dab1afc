"""Pages as they lie in the repository, with what Markdown elsewhere does not show.

The site's source is the whole repository, so a link of the repository is one of the site. Added as
a page is read: anchors of the tables of ``paper/results``, and the tutorials' pictures. As it is
written: a button that copies its code, if all of it is one program.
"""

import base64
import json
import re
from pathlib import Path
from typing import Any

from docutils.nodes import document
from sphinx.application import Sphinx

TUTORIALS = Path(__file__).parents[2] / "tutorials"
THUMBNAILS = {"1": 1, "2": 1, "4": 2, "6": 2, "7": 1, "9": 3}  # which picture; else the first

PROGRAMS = re.compile(r"docs/(start|choose|guide/.*|coming_from/.*)")  # the tests run them

NO_BREAK = "\N{NO-BREAK SPACE}"

CARD = """:::{{grid-item-card}} {number}. {title}
:link: {stem}
:link-type: doc
:img-top: pictures/{number}_{picture}.png
:img-alt: A figure of the tutorial {title}
{text}
:::"""


def prepare(app: Sphinx, page: str, source: list[str]) -> None:
    """Change the text of a page that is about to be read."""
    if (app.srcdir / f"{page}.md").exists():
        parts = source[0].split("```")  # code stays as it is
        parts[::2] = [re.sub(r"(?<=\d) (?=[%±])|(?<=±) ", NO_BREAK, part) for part in parts[::2]]
        source[0] = "```".join(parts)
    if page.startswith("paper/results/"):
        source[0] = anchored(page.split("/")[2], source[0])
    elif page == "tutorials/README":
        source[0] = gallery(source[0])
    elif page.startswith("tutorials/"):
        notebook = json.loads(source[0])
        link = f"{{nb-download}}`Download this notebook <{Path(page).name}.ipynb>`\n"
        notebook["cells"][0]["source"][1:1] = ["\n", link]
        source[0] = json.dumps(notebook)


def anchored(name: str, text: str) -> str:
    """Return the tables of an experiment, each below an anchor by its marker."""
    tables = re.sub(r"^<!-- (\S+:\S+) -->$", r"(\1)=\n", text, flags=re.MULTILINE)
    return f"---\norphan: true\n---\n\n# Tables of `paper {name}`\n\n{tables}"


def gallery(text: str) -> str:
    """Return the tutorials' README, its table as cards with pictures."""
    rows = re.findall(r"^\| \[(\d+)\. (.+?)\]\((.+?)\.ipynb\) \| (.+?) \|$", text, re.MULTILINE)
    cards = [
        CARD.format(number=n, title=t, stem=s, text=text, picture=THUMBNAILS.get(n, 0))
        for n, t, s, text in rows
    ]
    grid = "\n".join(["::::{grid} 1 2 2 2", ":gutter: 3", *cards, "::::"])
    tree = "\n".join(["```{toctree}", ":hidden:", *(stem for _, _, stem, _ in rows), "```"])
    table = re.search(r"^\|.*^\|.*?$", text, re.MULTILINE | re.DOTALL)
    return text.replace(table[0], f"{grid}\n\n{tree}")


def take_pictures(app: Sphinx) -> None:
    """Write the pictures of the tutorials, for their cards and for other pages."""
    for path in TUTORIALS.glob("*.ipynb"):
        cells = json.loads(path.read_text())["cells"]
        data = [output.get("data", {}) for cell in cells for output in cell.get("outputs", [])]
        for i, each in enumerate(each for each in data if "image/png" in each):
            picture = base64.b64decode("".join(each["image/png"]))
            target = TUTORIALS / "pictures" / f"{path.stem.partition('_')[0]}_{i}.png"
            if not target.exists() or target.read_bytes() != picture:
                target.parent.mkdir(exist_ok=True)
                target.write_bytes(picture)


def offer_code(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: document | None
) -> None:
    """Let a page have a button that copies all of its Python."""
    if PROGRAMS.fullmatch(page):
        app.add_js_file("copy_page.js")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the hooks."""
    app.connect("builder-inited", take_pictures)
    app.connect("source-read", prepare)
    app.connect("html-page-context", offer_code)
    return {"parallel_read_safe": True}
