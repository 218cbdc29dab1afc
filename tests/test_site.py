"""What the check of the built site finds."""

import subprocess
import sys
from pathlib import Path

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


def test_all_that_is_wrong_is_told(tmp_path):
    body = (
        '<a href="other.html">a</a><a href="page.html#there">a</a><img src="picture.png">'
        '<script src="https://host/x.js"></script><link rel="stylesheet" href="//host/x.css">'
    )
    result = check(tmp_path, body, '@font-face { src: url("https://host/f.woff") }')
    assert result.returncode == 1
    for told in (
        "other.html, which does not exist",
        "page.html#there, which has no such anchor",
        "picture.png, which does not exist",
        "loads https://host/x.js",
        "loads //host/x.css",
        "loads https://host/f.woff",
    ):
        assert told in result.stderr
