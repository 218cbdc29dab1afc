"""A page as a reader sees it, and small things to report on."""

import re
import sys
from xml.etree import ElementTree

import pytest

from gpadjust.__main__ import main
from gpadjust.report.markup import Markup
from gpadjust.validation import compare
from tests.systems import line, normal, wave


class Page:
    """A page of balanced tags as a reader sees it: text, tables, images, code."""

    def __init__(self, html):
        html = html.removeprefix("<!DOCTYPE html>")
        closed = re.sub(r"<(meta|img)\b([^>]*)>", r"<\1\2/>", html)
        self.root = ElementTree.fromstring(f"<page>{closed}</page>")
        self.styles = [style.text for style in self.root.iter("style")]
        for style in self.root.iter("style"):
            style.text = ""
        self.text = " ".join(" ".join(self.root.itertext()).split())
        self.images = [image.attrib for image in self.root.iter("img")]
        self.codes = [text_in(code) for code in self.root.iter("code")]
        self.tables = {
            text_in(table.find("caption")): [[*map(text_in, row)] for row in table.iter("tr")]
            for table in self.root.iter("table")
        }

    def needs_nothing_else(self):
        """Whether it refers to nothing but its own sections, and runs no script."""
        elements = [*self.root.iter()]
        ids = {f"#{element.get('id')}" for element in elements}
        names = {name for element in elements for name in element.attrib}
        return (
            all(image["src"].startswith("data:image/") for image in self.images)
            and {element.get("href") for element in elements} - {None} <= ids
            and all(element.tag == "img" or "src" not in element.attrib for element in elements)
            and not any(name.startswith("on") for name in names)
            and not {"script", "iframe", "link"} & {element.tag for element in elements}
            and not re.search(r"url\(|@import", "".join(self.styles))
        )

    def loading_code(self):
        """The only code that loads a model."""
        (code,) = [text for text in self.codes if "load(" in text]
        return code


def text_in(element):
    return "".join(element.itertext())


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
