"""Each example runs, prints what the gallery shows, and has a card and a picture there."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
GALLERY = (ROOT / "docs" / "gallery.md").read_text()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Optimization failed:RuntimeWarning")  # BoTorch tries again
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.stem)
def test_an_example_runs_and_prints_what_the_gallery_shows(example, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    runpy.run_path(str(example), run_name="__main__")
    assert (tmp_path / f"{example.stem}.png").stat().st_size > 5000
    section = GALLERY.partition(f"../examples/{example.name}\n")[2]
    shown = re.search(r"```text\n(.*?)```", section, flags=re.DOTALL)[1]
    words = re.compile(r"[^\W\d]+")  # its numbers are those of one machine
    assert words.findall(capsys.readouterr().out) == words.findall(shown)


def test_examples_have_cards_and_small_pictures():
    for example in EXAMPLES:
        name = example.stem
        assert f":link: {name}\n" in GALLERY, name
        assert f"({name})=\n" in GALLERY, name
        assert (ROOT / "docs" / "gallery" / f"{name}.png").stat().st_size < 60_000, name
        assert len(example.read_text().splitlines()) <= 70, name
