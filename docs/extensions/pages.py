"""Pages that are kept elsewhere: the tutorials, the paper's results, CONTRIBUTING and CHANGELOG.

`assemble` copies them beside the other pages, where git ignores them. Links in Markdown and in
notebooks are those of the repository, so that they work there, too; `localise` turns them into the
site's as Sphinx reads a page.
"""

import base64
import json
import re
import shutil
from pathlib import Path
from typing import Any

from mdit_py_plugins.anchors.index import slugify
from sphinx.application import Sphinx

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
PAPER = ROOT / "paper" / "README.md"
TUTORIALS = ROOT / "tutorials" / "README.md"
NOTEBOOKS = sorted((ROOT / "tutorials").glob("*.ipynb"), key=lambda p: int(p.stem.split("_")[0]))
THUMBNAILS = {1: 1, 2: 1, 4: 2, 6: 2, 7: 1, 9: 3}  # which picture of a tutorial; else its first

COPIES = {  # files of the repository that are pages of the site
    ROOT / "CHANGELOG.md": "changelog.md",
    ROOT / "CONTRIBUTING.md": "contributing.md",
    ROOT / "paper" / "machines" / "data" / "README.md": "paper/records.md",
    TUTORIALS: "tutorials/index.md",
    **{path: f"tutorials/{path.name}" for path in NOTEBOOKS},
}
ORIGINS = {place.rpartition(".")[0]: path for path, place in COPIES.items()}
WRITTEN: set[Path] = set()
MARKER = r"^<!-- (\S+:\S+) -->$"  # of a table, to which pages may link
ANCHORS: dict[str, str] = {}  # of the paper's results, and the page that each is on

CARD = """:::{{grid-item-card}} {number}. {title}
:link: {stem}
:link-type: doc
:img-top: pictures/{number}.png
:img-alt: A figure of the tutorial {title}
{text}
:::"""


def assemble() -> None:
    """Write the pages that are kept elsewhere into the folder of the site."""
    for path in COPIES.keys() - {TUTORIALS, *NOTEBOOKS}:
        write(COPIES[path], path.read_text())
    for path in NOTEBOOKS:
        add_notebook(path)
    write(COPIES[TUTORIALS], gallery(TUTORIALS.read_text()))
    split_results(PAPER.read_text())
    for folder in ("tutorials", "paper"):  # what a former build wrote of pages that are no more
        for path in (DOCS / folder).rglob("*.*"):
            if path not in WRITTEN:
                path.unlink()


def write(place: str, content: str | bytes) -> None:
    """Write a page or picture, unless it is there: Sphinx reads anew what has changed."""
    path = DOCS / place
    WRITTEN.add(path)
    data = content.encode() if isinstance(content, str) else content
    if not path.exists() or path.read_bytes() != data:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def add_notebook(path: Path) -> None:
    """Add a tutorial with a link to its file, and the picture for its card."""
    notebook, number = json.loads(path.read_text()), int(path.stem.split("_")[0])
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    pictures = [o["data"]["image/png"] for o in outputs if "image/png" in o.get("data", {})]
    picture = base64.b64decode("".join(pictures[THUMBNAILS.get(number, 0)]))
    write(f"tutorials/pictures/{number}.png", picture)
    lines = notebook["cells"][0]["source"]
    lines[1:1] = ["\n", f"{{nb-download}}`Download this notebook <{path.name}>`\n"]
    write(COPIES[path], json.dumps(notebook))


def gallery(text: str) -> str:
    """The tutorials' README, its table as cards with pictures."""
    rows = re.findall(r"^\| \[(\d+)\. (.+?)\]\((.+?)\.ipynb\) \| (.+?) \|$", text, re.MULTILINE)
    cards = [CARD.format(number=n, title=t, stem=s, text=text) for n, t, s, text in rows]
    grid = "\n".join(["::::{grid} 1 2 2 3", ":gutter: 3", *cards, "::::"])
    tree = "\n".join(["```{toctree}", ":hidden:", *(stem for _, _, stem, _ in rows), "```"])
    table = re.search(r"^\|.*^\|.*?$", text, re.MULTILINE | re.DOTALL)
    return text.replace(table[0], f"{grid}\n\n{tree}")


def split_results(text: str) -> None:
    """A page for each section of the paper's README, a first one for what is before them."""
    text = text.replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}")  # in cells of tables
    first, *sections = re.split(r"^(?=## )", text, flags=re.MULTILINE)
    names = []
    for section in sections:
        titles = re.findall(r"^#+ (.+)$", section, re.MULTILINE)
        tables = re.findall(MARKER, section, re.MULTILINE)
        names.append(slugify(titles[0]))
        ANCHORS.update(dict.fromkeys([*map(slugify, titles), *tables], names[-1]))
    ANCHORS[slugify(first.partition("\n")[0].strip("# "))] = "index"
    tree = "\n".join(["```{toctree}", ":maxdepth: 1", *names, "records", "```", ""])
    for name, content in zip(["index", *names], [first + tree, *sections], strict=True):
        page = re.sub(r"^#(#+ )", r"\1", content, flags=re.MULTILINE)
        write(f"paper/{name}.md", re.sub(MARKER, r"(\1)=\n", page, flags=re.MULTILINE))
        ORIGINS[f"paper/{name}"] = PAPER


def localise(app: Sphinx, page: str, source: list[str]) -> None:
    """Turn the links of a Markdown page or notebook from the repository's into the site's."""
    origin = ORIGINS.get(page, DOCS / f"{page}.md")
    if origin.exists():
        pattern = r"(?<=\]\()([^)#\s\\]*)(?:#([^)\s]+))?(?=\))"
        source[0] = re.sub(pattern, lambda link: place(origin, *link.groups("")), source[0])


def place(origin: Path, link: str, anchor: str) -> str:
    """Where a link of the repository leads to on the site."""
    end = f"#{anchor}" if anchor else ""
    if not link and not anchor:
        return ""
    target = (origin.parent / link).resolve() if link else origin
    if target == PAPER:
        return f"/paper/{ANCHORS[anchor] if anchor else 'index'}.md{end.lower()}"
    if not link or not target.is_file():
        return link + end
    if target in COPIES:
        return f"/{COPIES[target]}{end}"
    if not target.is_relative_to(DOCS):
        copy = DOCS / "files" / target.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(target, copy)
        target = copy
    return f"/{target.relative_to(DOCS)}{end}"


def setup(app: Sphinx) -> dict[str, Any]:
    """Assemble the pages, and register the hook."""
    assemble()
    app.connect("source-read", localise)
    return {"parallel_read_safe": True}
