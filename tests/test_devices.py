"""Tensors are made where the data are: kept without a GPU by reading the code."""

import ast
from pathlib import Path

import gpadjust

ROOT = Path(gpadjust.__file__).parent
ROOMS = ("physics", "core", "kinds", "many")
FACTORIES = "arange empty eye full linspace ones rand randint randn randperm scalar_tensor tensor"
FACTORIES = {*FACTORIES.split(), "zeros"}
# Functions that may make tensors on the CPU, by why.
ALLOWED = {
    "numbers of rows or draws, which index tensors of any device": {
        "core/fitting.py": "_parts _evenly",
        "core/functions.py": "__init__",
        "core/model.py": "log_likelihood",
        "core/nuts.py": "proposed",
        "physics/formula.py": "_parsed",
        "core/saving.py": "_built_with _content",
        "core/stacked.py": "__init__ components mixture",
        "core/summary.py": "_of_term",
        "kinds/categories.py": "__init__",
        "kinds/pyro_model.py": "pyro_model",
        "kinds/updates.py": "__init__ _updated",
        "many/rest.py": "rest_of",
        "many/variational_cka.py": "fit_itself",
        "physics/base.py": "forward",
    },
    "drawn on the CPU, so that a seed says the same everywhere, and moved": {
        "core/fourier.py": "__init__",
        "core/model.py": "sample_functions",
    },
    "numbers that become Python's, a file's, or are moved where they are used": {
        "core/stacked.py": "_shares",
        "core/unknowns.py": "__init__",
        "kinds/links.py": "parse",
        "physics/parameters.py": "__init__",
        "physics/unknown.py": "_tails guess knots",
    },
}


def is_factory(node):
    match node:
        case ast.Call(func=ast.Attribute(value=ast.Name(id="torch"), attr=name), keywords=options):
            return name in FACTORIES and "device" not in {option.arg for option in options}
    return False


def unplaced(source):
    """Functions with factory calls without a device that no `.to(...)` of the expression moves."""
    tree, moved = ast.parse(source), set()
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Attribute(value=value, attr="to" | "type_as" | "copy_")):
                moved |= {*ast.walk(value)}
    names = {}
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            calls = {node for node in ast.walk(function) if is_factory(node)} - moved
            names |= {call.lineno: function.name for call in calls}
    return {*names.values()}


def test_the_check_finds_what_it_is_for():
    bad = "def f(x):\n    return x + torch.zeros(3)\n"
    assert unplaced(bad) == {"f"}
    for good in ("torch.zeros(3, device=x.device)", "torch.zeros(3).to(x)", "x.new_zeros(3)"):
        assert not unplaced(bad.replace("torch.zeros(3)", good))


def test_tensors_are_made_where_the_data_are():
    found = {
        f"{path.relative_to(ROOT).as_posix()} {name}"
        for room in ROOMS
        for path in (ROOT / room).glob("*.py")
        for name in unplaced(path.read_text())
    }
    files = [pair for by_file in ALLOWED.values() for pair in by_file.items()]
    allowed = {f"{file} {name}" for file, names in files for name in names.split()}
    assert not found - allowed, "make it with `device=`, `x.new_...` or `.to(x)`"
    assert not allowed - found, "these need no exception any more"
