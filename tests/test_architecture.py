"""The plan of the house, kept by tests: see docs/architecture.md."""

import ast
import sys
from pathlib import Path

import torch

import gpadjust
from gpadjust import CKA, fit

ROOT = Path(gpadjust.__file__).parent
FLOORS = [
    *("physics", "states", "envs", "gp", "models", "inference", "validation"),
    *("report", "sklearn", "active", "dynamics", "control", "rl"),
]


def passed(call):
    """The files and classes of the library whose code a call runs."""
    files, classes = set(), set()

    def record(frame, event, argument):
        path = frame.f_code.co_filename
        if event == "call" and path.startswith(str(ROOT)):
            files.add(Path(path).relative_to(ROOT).as_posix())
            outer, dot, inner = frame.f_code.co_qualname.partition(".")
            if dot and not inner.startswith("<locals>"):
                classes.add(outer)

    sys.setprofile(record)
    try:
        call()
    finally:
        sys.setprofile(None)
    return files, classes


def sine(X):
    return torch.sin(6 * X)


def first_call():
    X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
    model = CKA(X, 2 * sine(X) + X, physics=sine)
    fit(model, "map")
    posterior = model.posterior(X)
    return posterior.mean, posterior.variance


def test_the_first_call_passes_few_files_and_classes():
    files, classes = passed(first_call)
    # Among them physics/unknown.py, which says that nothing is unknown, and three of models/ that
    # say what a model predicts, what of rho and delta, and how an exact one is made.
    assert len(files) <= 21, sorted(files)
    assert len(classes) <= 21, sorted(classes)


def imports(path):
    """The modules of the library that a file imports, annotations' included, and names of them."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gpadjust."):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_the_plan_has_each_room():
    assert sorted(FLOORS) == sorted(path.parent.name for path in ROOT.glob("*/__init__.py"))


def test_imports_point_one_way():
    for path in ROOT.glob("*/**/*.py"):
        floor = path.relative_to(ROOT).parts[0]
        for module in imports(path):
            other = module.split(".")[1]
            assert FLOORS.index(other) <= FLOORS.index(floor), f"{path.name} imports {module}"


def test_no_module_knows_its_owner():
    graph = {}
    for path in ROOT.glob("*/**/*.py"):
        if path.name != "__init__.py":
            module = ".".join(["gpadjust", *path.relative_to(ROOT).with_suffix("").parts])
            graph[module] = {name for name in imports(path) if name != module}
    done = set()

    def visit(module, above):
        assert module not in above, f"a circle: {[*above, module]}"
        if module not in done:
            for other in graph.get(module, ()):
                visit(other, [*above, module])
            done.add(module)

    for module in graph:
        visit(module, [])
