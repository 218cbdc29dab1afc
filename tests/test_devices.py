"""Tensors are made where the data are: kept without a GPU by reading the code."""

import ast
from pathlib import Path

import gpadjust

ROOT = Path(gpadjust.__file__).parent
ROOMS = ("physics", "core", "kinds", "many")
FACTORIES = {
    *("arange", "empty", "eye", "full", "linspace", "ones", "rand", "randint", "randn", "randperm"),
    *("scalar_tensor", "tensor", "zeros"),
}
# Functions that may make tensors on the CPU, by why.
ALLOWED = {
    "numbers of rows or draws, which index tensors of any device": {
        "core/fitting.py _parts",
        "core/fitting.py _evenly",
        "core/fitting.py modes",
        "core/functions.py __init__",
        "core/model.py log_likelihood",
        "core/nuts.py proposed",
        "physics/formula.py _parsed",
        "core/saving.py _built_with",
        "core/saving.py _content",
        "core/stacked.py __init__",
        "core/stacked.py components",
        "core/stacked.py mixture",
        "core/summary.py _of_term",
        "kinds/categories.py __init__",
        "kinds/pyro_model.py pyro_model",
        "kinds/updates.py __init__",
        "kinds/updates.py _updated",
        "many/rest.py rest_of",
        "many/variational_cka.py fit_itself",
        "physics/base.py forward",
    },
    "drawn on the CPU, so that a seed says the same everywhere, and moved": {
        "core/fourier.py __init__",
        "core/model.py sample_functions",
    },
    "numbers that become Python's, a file's, or are moved where they are used": {
        "core/stacked.py _shares",
        "core/unknowns.py __init__",
        "kinds/links.py parse",
        "physics/parameters.py __init__",
        "physics/unknown.py _tails",
        "physics/unknown.py guess",
        "physics/unknown.py knots",
    },
}


def is_factory(node):
    function = node.func if isinstance(node, ast.Call) else None
    return (
        isinstance(function, ast.Attribute)
        and isinstance(function.value, ast.Name)
        and function.value.id == "torch"
        and function.attr in FACTORIES
        and not any(keyword.arg == "device" for keyword in node.keywords)
    )


def unplaced(source):
    """Factory calls without a device that no `.to(...)` of the same expression moves."""
    tree = ast.parse(source)
    moved = set()
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in ("to", "type_as", "copy_")
        ):
            moved |= {id(inner) for inner in ast.walk(node.func.value)}
    found = []
    for outer in ast.walk(tree):
        if isinstance(outer, ast.FunctionDef):
            found += [
                (outer.name, node.lineno)
                for node in ast.walk(outer)
                if is_factory(node) and id(node) not in moved
            ]
    return {line: name for name, line in found}


def test_the_check_finds_what_it_is_for():
    bad = "def f(x):\n    return x + torch.zeros(3)\n"
    assert unplaced(bad) == {2: "f"}
    for good in ("torch.zeros(3, device=x.device)", "torch.zeros(3).to(x)", "x.new_zeros(3)"):
        assert not unplaced(bad.replace("torch.zeros(3)", good))


def test_tensors_are_made_where_the_data_are():
    found = {
        f"{path.relative_to(ROOT).as_posix()} {name}"
        for room in ROOMS
        for path in (ROOT / room).glob("*.py")
        for name in unplaced(path.read_text()).values()
    }
    allowed = set().union(*ALLOWED.values())
    assert not found - allowed, "make it with `device=`, `x.new_...` or `.to(x)`"
    assert not allowed - found, "these need no exception any more"
