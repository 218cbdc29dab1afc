"""Each example runs, prints what the gallery shows, and has a card and a picture there."""

import re
import runpy
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SLOW = {"nuclides", "pendulum", "reactor", "yacht"}
GALLERY = (ROOT / "docs" / "gallery.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    "example",
    [pytest.param(e, marks=pytest.mark.slow if e.stem in SLOW else ()) for e in EXAMPLES],
    ids=lambda example: example.stem,
)
def test_an_example_runs_and_prints_what_the_gallery_shows(example, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    runpy.run_path(str(example), run_name="__main__")
    plt.close("all")
    assert (tmp_path / f"{example.stem}.png").stat().st_size > 5000
    section = GALLERY.partition(f"../examples/{example.name}\n")[2]
    shown = re.search(r"```text\n(.*?)```", section, flags=re.DOTALL)[1]
    words = re.compile(r"[^\W\d]+")  # its numbers are those of one machine
    assert words.findall(capsys.readouterr().out) == words.findall(shown)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.stem)
def test_an_example_has_its_card_and_a_small_picture(example):
    assert f":link: {example.stem}\n" in GALLERY
    assert f"({example.stem})=\n" in GALLERY
    assert (ROOT / "docs" / "gallery" / f"{example.stem}.png").stat().st_size < 60_000
    assert len(example.read_text().splitlines()) <= 70
