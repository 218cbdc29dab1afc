"""Formulas by MathJax, of which the site has a copy: nothing is loaded from another host."""

import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

SCRIPT, FONTS = "tex-chtml.js", "output/chtml/fonts/woff-v2"


def copy_mathjax(app: Sphinx, error: Exception | None) -> None:
    """Copy script and fonts of the package that carries them beside the other static files."""
    package = find_spec("mathjax").submodule_search_locations[0]  # to import it takes Django
    source = Path(package) / "static" / "mathjax" / "es5"
    target = app.outdir / "_static" / "mathjax"
    shutil.copytree(source / FONTS, target / FONTS, dirs_exist_ok=True)
    shutil.copy2(source / SCRIPT, target / SCRIPT)


def setup(app: Sphinx) -> dict[str, Any]:
    """Say where MathJax is, and register the hook."""
    app.setup_extension("sphinx.ext.mathjax")
    app.config.mathjax_path = f"mathjax/{SCRIPT}"
    app.connect("build-finished", copy_mathjax)
    return {"parallel_read_safe": True}
