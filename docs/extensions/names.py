"""Public names: their entries in the reference, and links to these from wherever they stand."""

import re
import sys
from importlib import import_module
from inspect import isroutine
from pathlib import Path
from pydoc import locate
from typing import Any

from docutils.nodes import Element, TextElement, document, literal, reference, title
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.pycode import ModuleAnalyzer
from sphinx.util import inspect
from sphinx.util.logging import getLogger

REFERENCE = Path(__file__).parents[1] / "reference"
PAGES = {page.stem for page in REFERENCE.glob("*.rst")} - {"index"}
MODULES = [
    "gpadjust",
    *(f"gpadjust.{n}" for n in sorted(PAGES - {"gpadjust"})),
    "gpadjust.gpytorch",
]
ROOMS = [import_module(name) for name in (*MODULES, "gpadjust.validation.plots")]
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
        found = getattr(room, name)
        if id(found) in CONSTANTS and getattr(found, "__name__", "") != name:
            docs["", name] = CONSTANTS[id(found)]


WORDS = re.compile(r"collect|compare|smooth|fit\(model")
LITERALS = {n: ENTRIES[id(getattr(room, n))] for room in ROOMS for n in room.__all__}


def link_literals(app: Sphinx, document: document) -> None:
    """Link code in a line that is a public name, or a call of one, such as ``CKA(...)``."""
    for node in list(document.findall(literal)):
        text = node.astext()
        name = re.sub(r"\(.*", "", text, flags=re.DOTALL).rpartition(".")[2]
        plain = name.islower() and "_" not in name  # fit and score are methods of others, too
        if name not in LITERALS or (plain and not WORDS.match(text)):
            continue
        if isinstance(node.parent, reference | title | pending_xref):
            continue
        target = {"refdomain": "py", "reftype": "obj", "reftarget": LITERALS[name]}
        node.replace_self(pending_xref("", node.deepcopy(), refdoc=app.env.docname, **target))


def order_entries(app: Sphinx, page: str, source: list[str]) -> None:
    """Show the entries of a room in the order of the table at the head of its page."""
    for part in source[0].split(".. currentmodule:: ")[1:] if "/reference/" in page else ():
        room, listed = part.split()[0], re.findall(r"^   (\w+)$", part, re.MULTILINE)
        entries = [f".. {directive(locate(f'{room}.{name}'))}:: {name}" for name in listed]
        head = [f".. automodule:: {room}\n   :no-members:"] if room != "gpadjust" else []
        text = "\n\n".join([*head, *entries])  # the cheat sheet has the docstring of gpadjust
        source[0] = re.sub(rf"^\.\. automodule:: {room}(?=\n\n|\n?\Z)", text, source[0], flags=re.M)


def directive(found: Any) -> str:
    """Name of the directive of autodoc that shows an object."""
    if isinstance(found, type):
        return "autoexception" if issubclass(found, Exception) else "autoclass"
    return "autofunction" if isroutine(found) else "autodata"


def entry_of(found: Any) -> str | None:
    """Name in the reference of an object, or of a method by its class."""
    entry = ENTRIES.get(id(found))
    if entry is None and hasattr(found, "__qualname__"):
        owner, _, name = f"{found.__module__}.{found.__qualname__}".rpartition(".")
        entry = f"{ENTRIES.get(id(locate(owner)), owner)}.{name}"
    return entry


def link_other_names(
    app: Sphinx, env: BuildEnvironment, node: Element, content: TextElement
) -> Element | None:
    """Link ``gpadjust.CKA`` to its entry in its room, and an inherited method to its base's."""
    entry = entry_of(locate(node["reftarget"]))
    if entry in (None, node["reftarget"]):
        return None
    domain = env.get_domain("py")
    return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", entry, node, content)


def sign(
    app: Sphinx, what: str, name: str, found: Any, options: Any, signature: str, returns: str
) -> tuple[str, None] | None:
    """Sign a class by its ``__init__`` where autodoc does by a ``__new__`` of any arguments."""
    if what != "class" or not signature or not signature.startswith("(*args"):
        return None
    arguments = inspect.signature(found.__init__, bound_method=True)
    signed = inspect.stringify_signature(
        arguments, show_return_annotation=False, unqualified_typehints=True
    )
    return re.sub(r"<class '[\w.]*?(\w+)'>", r"\1", signed), None


def skip_field_aliases(
    app: Sphinx, what: str, name: str, member: Any, skip: bool, options: Any
) -> bool | None:
    """Leave out a named tuple's fields, which its docstring tells."""
    return str(getattr(member, "__doc__", "")).startswith("Alias for field number") or None


def check_complete(app: Sphinx, env: BuildEnvironment) -> None:
    """Warn of public names that no page shows."""
    for name in set(ENTRIES.values()) - set(env.get_domain("py").objects):
        getLogger("docs").warning("%s has no entry: give it a docstring", name)


def mend_ways_back(
    app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: document | None
) -> None:
    """Lead from the source to the entry also where viewcode mistakes the module of its name."""
    entries, module = app.env.get_domain("py").objects, page.removeprefix("_modules/")

    def mended(anchor: re.Match[str]) -> str:
        parts = anchor[1].split(".")
        ends = [".".join(parts[i:]) for i in range(1, len(parts))]
        here = [f"{module.replace('/', '.')}.{end}" for end in ends]
        names = [anchor[1], *here, *(entry_of(locate(name)) for name in here)]
        return f'#{next(name for name in names if name in entries)}"'

    if page.startswith("_modules/gpadjust/"):
        context["body"] = re.sub(r'(?<=html)#(gpadjust[\w.]*)"', mended, context["body"])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the hooks."""
    app.connect("source-read", order_entries)
    app.connect("doctree-read", link_literals)
    app.connect("missing-reference", link_other_names)
    app.connect("autodoc-process-signature", sign)
    app.connect("autodoc-skip-member", skip_field_aliases)
    app.connect("env-check-consistency", check_complete)
    app.connect("html-page-context", mend_ways_back)
    return {"parallel_read_safe": True}
