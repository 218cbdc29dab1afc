"""What the check of the built site finds."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "docs" / "check_links.py"


def check(folder, body, style=""):
    (folder / "page.html").write_text(f'<h1 id="here">x</h1>{body}')
    (folder / "site.css").write_text(style)
    command = [sys.executable, str(SCRIPT), str(folder)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_sound_site_passes(tmp_path):
    sound = '<a href="#here">a</a><a href="page.html#here">b</a><a href="https://botorch.org">c</a>'
    result = check(tmp_path, sound)
    assert result.returncode == 0
    assert "1 pages, 2 internal links: 0 problems" in result.stdout


@pytest.mark.parametrize(
    ("body", "style", "found"),
    [
        ('<a href="other.html">a</a>', "", "other.html, which does not exist"),
        ('<a href="page.html#there">a</a>', "", "page.html#there, which has no such anchor"),
        ('<img src="picture.png">', "", "picture.png, which does not exist"),
        ('<script src="https://host/x.js"></script>', "", "loads https://host/x.js"),
        ('<link rel="stylesheet" href="//host/x.css">', "", "loads //host/x.css"),
        ("", '@font-face { src: url("https://host/f.woff") }', "loads https://host/f.woff"),
    ],
)
def test_what_is_wrong_is_told(tmp_path, body, style, found):
    result = check(tmp_path, body, style)
    assert result.returncode == 1
    assert found in result.stderr
