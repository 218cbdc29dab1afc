"""How Sphinx builds the API reference: from the docstrings, without the network."""

import sys
from importlib import import_module
from pathlib import Path
from pydoc import locate
from typing import Any

from docutils.nodes import Element, TextElement
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.logging import getLogger

import gpadjust

project = "gpadjust"
author = "The gpadjust authors"
project_copyright = author
release = version = gpadjust.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
]
myst_enable_extensions = ["dollarmath"]
exclude_patterns = ["_build"]
default_role = "py:obj"  # single backticks link where they can, and are code elsewhere
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!gpadjust\.).*")]  # links to other libraries need the network
nitpick_ignore = [  # what signatures name, but users do not call by name
    ("py:class", "gpadjust.envs.arm.view.ArmView"),
    ("py:class", "gpadjust.envs.cart_pole.view.CartPoleView"),
    ("py:class", "gpadjust.envs.viewed_env.ViewedEnv"),
    ("py:class", "gpadjust.inference.fitting.FitOptions"),
    ("py:class", "gpadjust.dynamics.incremental_fit.DynamicsFitOptions"),
    ("py:class", "gpadjust.dynamics.control_steps.Stretch"),
    ("py:class", "gpadjust.dynamics.smoothing.Estimate"),
    ("py:class", "gpadjust.models.stacked.Part"),
    ("py:class", "gpadjust.models.cholesky_strategy.CholeskyStrategy"),
    ("py:class", "gpadjust.models.sampled_functions.TermFeatures"),
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

PAGES = {page.stem for page in Path(__file__).parent.glob("*.rst")} - {"index"}
ROOMS = [import_module(f"gpadjust.{name}") for name in (*sorted(PAGES), "validation.plots")]
ENTRIES = {id(getattr(room, n)): f"{room.__name__}.{n}" for room in ROOMS for n in room.__all__}
SOURCES = [ModuleAnalyzer.for_module(n) for n in list(sys.modules) if n.startswith("gpadjust.")]
CONSTANTS = {  # the docstrings that follow assignments
    id(getattr(sys.modules[source.modname], name)): lines
    for source in SOURCES
    for (owner, name), lines in source.find_attr_docs().items()
    if owner == ""
}
for room in ROOMS:  # autodoc looks for them in the room's __init__ alone
    docs = ModuleAnalyzer.for_module(room.__name__).find_attr_docs()
    for name in room.__all__:
        if id(getattr(room, name)) in CONSTANTS:
            docs["", name] = CONSTANTS[id(getattr(room, name))]


def link_other_names(
    app: Sphinx, env: BuildEnvironment, node: Element, content: TextElement
) -> Element | None:
    """Link ``gpadjust.CKA`` to its entry in its room, and an inherited method to its base's."""
    found = locate(node["reftarget"])
    entry = ENTRIES.get(id(found))
    if entry is None and hasattr(found, "__qualname__"):
        owner, _, name = f"{found.__module__}.{found.__qualname__}".rpartition(".")
        entry = f"{ENTRIES.get(id(locate(owner)), owner)}.{name}"
    if entry in (None, node["reftarget"]):
        return None
    domain = env.get_domain("py")
    return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", entry, node, content)


def skip_field_aliases(
    app: Sphinx, what: str, name: str, member: Any, skip: bool, options: Any
) -> bool | None:
    """Leave out a named tuple's fields, which its docstring tells."""
    return str(getattr(member, "__doc__", "")).startswith("Alias for field number") or None


def check_complete(app: Sphinx, env: BuildEnvironment) -> None:
    """Warn of public names that no page shows."""
    for name in set(ENTRIES.values()) - set(env.get_domain("py").objects):
        getLogger("docs").warning("%s has no entry: give it a docstring", name)


def setup(app: Sphinx) -> None:
    """Register the hooks."""
    app.connect("missing-reference", link_other_names)
    app.connect("autodoc-skip-member", skip_field_aliases)
    app.connect("env-check-consistency", check_complete)
