"""A page as a reader sees it, and small things to report on."""

import re
import sys
from html.parser import HTMLParser

import pytest

from gpadjust.__main__ import main
from gpadjust.report.markup import Markup
from gpadjust.validation import compare
from tests.systems import line, normal, wave

VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """What is in a page: its text, tables, images, code, and attributes; its tags are balanced."""

    def __init__(self, html):
        super().__init__()
        self.open, self.pieces, self.tables, self.images = [], [], {}, []
        self.codes, self.attributes, self.styles, self.ids = [], [], [], []
        self.tags = set()
        self.feed(html)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(self.pieces).split())

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.tags.add(tag)
        self.attributes += [(tag, *pair) for pair in attributes]
        self.ids += [named["id"]] if "id" in named else []
        if tag == "img":
            self.images.append(named)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.rows = []
        elif tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
        elif tag == "caption":
            self.caption = ""
        elif tag == "code":
            self.codes.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        if tag == "table":
            self.tables[self.caption] = self.rows

    def handle_data(self, data):
        if self.open[-1:] == ["style"]:
            self.styles.append(data)
            return
        self.pieces.append(data)
        if "code" in self.open:
            self.codes[-1] += data
        elif "caption" in self.open:
            self.caption += data
        elif {"td", "th"} & {*self.open}:
            self.rows[-1][-1] += data

    def needs_nothing_else(self):
        """Whether it refers to nothing but its own sections, and runs no script."""
        links = [(tag, value) for tag, name, value in self.attributes if name in ("src", "href")]
        own = all(
            value.startswith("data:image/") if tag == "img" else value[1:] in self.ids
            for tag, value in links
        )
        has_events = any(name.startswith("on") for _, name, _ in self.attributes)
        is_quiet = not has_events and not {"script", "iframe"} & self.tags
        return own and is_quiet and not re.search(r"url\(|@import", "".join(self.styles))

    def loading_code(self):
        """The only code that loads a model."""
        (code,) = [text for text in self.codes if "load(" in text]
        return code


@pytest.fixture
def read():
    """Reads the page at a path."""
    return lambda path: Page(path.read_text(encoding="utf-8"))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, and modules of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    for name in ("hill", "broken", "lacks", "swing"):
        sys.modules.pop(name, None)


@pytest.fixture
def fails(folder, capsys):
    """Asserts that a command ends with an error of these words, and that no file changes."""

    def contents():
        return {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}

    def fails(command, words):
        capsys.readouterr()
        before = contents()
        assert main(command) == 1
        out, err = capsys.readouterr()
        assert out == ""
        assert "Traceback" not in err
        assert re.search(words, err, flags=re.DOTALL | re.MULTILINE), err
        assert contents() == before

    return fails


@pytest.fixture
def undrawn(monkeypatch):
    """Leaves the figures out, which take most of the time."""
    for name in ("agreement", "corrections", "densities", "left_out", "coverages"):
        monkeypatch.setattr(f"gpadjust.report.figures.{name}", lambda *args: Markup())
    for name in ("_runs", "_states"):
        monkeypatch.setattr(f"gpadjust.report.log_page.{name}", lambda *args: Markup())


@pytest.fixture(scope="session")
def comparison():
    """Of ten noisy points of a wave."""
    X = line(10)
    Y = 2 * wave(X) + X + 0.1 * normal(10, 1)
    return compare(X, Y, wave, structures=["zero mean", "physics mean", "CKA"])
