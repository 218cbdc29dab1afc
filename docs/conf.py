"""How Sphinx builds the site: from pages, docstrings and committed outputs, without the network.

Its source is the repository: ``sphinx-build -W --keep-going -b html -c docs . docs/_build``.
"""

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
    "CONTRIBUTING.md",
    "docs/**",
    "paper/*.md",
    "paper/*/README.md",
    "paper/real/data/README.md",
    "paper/results/*/tables.md",
    "tutorials/*",
]
exclude_patterns = ["docs/_build", "docs/jupyter_execute"]
default_role = "py:obj"  # single backticks link where they can, and are code elsewhere
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!gpadjust\.).*")]  # links to other libraries need the network
nitpick_ignore = [  # what signatures name, but users do not call by name
    ("py:class", "gpadjust.envs.arm.view.ArmView"),
    ("py:class", "gpadjust.envs.cart_pole.view.CartPoleView"),
    ("py:class", "gpadjust.envs.viewed_env.ViewedEnv"),
    ("py:class", "gpadjust.inference.fitting.FitOptions"),
    ("py:class", "gpadjust.dynamics.learning.DynamicsFitOptions"),
    ("py:class", "gpadjust.records.record.Stretch"),
    ("py:class", "gpadjust.records.smoothing.Estimate"),
    ("py:class", "gpadjust.records.chain.Known"),
    ("py:class", "gpadjust.models.local_errors.LocalErrors"),
    ("py:class", "gpadjust.models.stacked.Part"),
    ("py:class", "gpadjust.gp.kernels.AnyKernel"),
    ("py:class", "gpadjust.gp.kernels.Batched"),
    ("py:class", "gpadjust.gp.kernels.CompositeKernel"),
    ("py:class", "gpadjust.gp.kernels.Stationary"),
    ("py:class", "gpadjust.gp.noise.Noise"),
    ("py:class", "gpadjust.models.exact_conditioning.ExactConditioning"),
    ("py:class", "gpadjust.models.rra.PaperConditioning"),
    ("py:class", "gpadjust.models.rra.WeightConditioning"),
    ("py:class", "gpadjust.models.sparse_conditioning.SparseConditioning"),
    ("py:class", "gpadjust.models.sampled_functions.TermFeatures"),
    ("py:class", "gpadjust.models.stacked.StackedFunctions"),
    ("py:class", "gpadjust.rl.buffer.CompactReplayBuffer"),
    ("py:class", "gpadjust.rl.checkpoint.Agent"),
    ("py:class", "gpadjust.rl.episode_loop.EpisodeLoop"),
    ("py:class", "gpadjust.rl.model_vec_env.ModelStep"),
    ("py:class", "gpadjust.rl.recorded_episodes.RecordedEpisodes"),
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
