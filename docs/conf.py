"""How Sphinx builds the site: from pages, docstrings and committed outputs, without the network.

Its source is the repository: ``sphinx-build -W --keep-going -b html -c docs . docs/_build``. Of a
site with several versions, each is built into a folder of its name, with ``SITE_URL``, the address
of that folder, and ``SITE_VERSIONS``, the names of the others.
"""

import os
import sys
from pathlib import Path

import gpadjust

project = "gpadjust"
author = "The gpadjust authors"
project_copyright = author
release = version = gpadjust.__version__

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "formulas",
    "names",
    "pages",
    "previews",
]
myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # pages show the committed outputs
nb_ipywidgets_js: dict[str, dict[str, str]] = {}  # by default from another host
nb_merge_streams = True
copybutton_exclude = ".linenos, .gp, .go"
root_doc = "docs/index"
include_patterns = [
    "CHANGELOG.md",
    "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "docs/**",
    "paper/*.md",
    "paper/*/*.md",
    "paper/*/data/README.md",
    "paper/results/*/tables.md",
    "tutorials/*",
]
exclude_patterns = ["docs/_build", "docs/jupyter_execute"]
default_role = "py:obj"  # single backticks link where they can, and are code elsewhere
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(?!gpadjust\.).*"),  # links to other libraries need the network
    ("py:(class|obj)", r"gpadjust(\.\w+){3,}"),  # inner classes, which signatures name
]

autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
autosummary_generate = False
napoleon_numpy_docstring = False
napoleon_use_ivar = True
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"gpadjust {release}"
html_show_sourcelink = False

html_logo = html_favicon = "_static/logo.svg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["index.html"]  # leads from the site's root to docs/
html_copy_source = False
html_baseurl = os.environ.get("SITE_URL", "")

templates_path = ["_templates"]
html_context = {"versions": os.environ.get("SITE_VERSIONS", "").split()}
html_sidebars = {
    "**": [
        "sidebar/brand.html",
        "versions.html",
        "sidebar/search.html",
        "sidebar/scroll-start.html",
        "sidebar/navigation.html",
        "sidebar/scroll-end.html",
    ]
}
