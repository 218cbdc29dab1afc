"""The plan of the house, kept by tests: see docs/architecture.md."""

import ast
import io
import re
import sys
import tokenize
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import gpytorch
import pytest
import torch
from botorch.models.model import Model

import gpadjust
from gpadjust import CKA, fit
from gpadjust.__main__ import main
from gpadjust.dynamics import LearnedDynamics
from gpadjust.physics import as_physics
from gpadjust.records import Records, smooth
from gpadjust.states import StateSpec
from tests.systems import line, wave

ROOT = Path(gpadjust.__file__).parent
FLOORS = [
    *("checks", "progress", "threads", "words", "display", "states", "physics", "core", "files"),
    *("kinds", "many", "gpytorch", "validation", "sklearn", "ax", "active", "dynamics", "export"),
    *("records", "report", "control", "systems", "rl"),
]
ROOMS = sorted(path.parent for path in ROOT.glob("*/__init__.py"))
by_room = pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.name)
BELOW = ("botorch", "gpytorch", "linear_operator")  # libraries that ours builds on


CONDITIONALS, TUPLES = 15, 20  # of 1,000 lines of code, at most
COMMENTS = 7  # of 100 lines of code, at least
VAGUE = {"found", "told", "given", "known", "kept", "seen", "own", "whole", "each", "said"}
AVOIDED = re.compile(
    r"\b(next to nothing|by the default fit|of one's own|is none|(is|are) said|says?|told|"
    r"whether to|goes on|pays|errs?|look at it)\b"
)
MASKS = {  # true arithmetic: tensors of 0 and 1
    ("control/rollouts.py", "violation.max() * left"),
    ("core/kernels.py", "slope * (e < 0)"),
    ("kinds/categories.py", "own['outputscale'].unsqueeze(-1) * same"),
    ("many/conditioning.py", "(targets - total.mean).nan_to_num() * is_observed"),
    ("many/conditioning.py", "residual.nan_to_num() * self.is_late"),
}
# Functions that return truth values, besides those annotated as bool.
TRUTHS = "bool isinstance issubclass callable hasattr any all isfinite isnan startswith endswith"
LAYOUT = {getattr(tokenize, name) for name in ("NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER")}
DIRECTIVE = re.compile(r"#\s*(fmt|noqa|type)\b")

CSV_TO_FREE_RUN = 31  # files that a log passes on the way to a judged free run
TRIAL, ITERATION = 36, 36  # that a planned trial and an iteration of Dyna pass, fits included
OF_CONTROL, OF_CONTROL_AND_RL = 10, 10  # of these
FILES, CLASSES, FUNCTIONS = 14, 16, 132  # that the ten lines of the README pass; fewer are better
CORE_LINES = 5397
REPORT, WITH_A_REPORT = 14, 29  # of report and validation, and of what is below, by default
IDENTIFIED = 31  # that a log passes on the way to its page


def passed(call, root=ROOT):
    """The files, classes and functions of a folder, the library's, whose code a call runs.

    Comprehensions are no functions: since Python 3.12 they are not called.
    """
    files, classes, functions = set(), set(), set()

    def record(frame, event, argument):
        path = frame.f_code.co_filename
        if event == "call" and path.startswith(str(root)):
            name = frame.f_code.co_qualname
            files.add(Path(path).relative_to(root).as_posix())
            outer, dot, inner = name.partition(".")
            if dot and not inner.startswith("<locals>"):
                classes.add(outer)
            if not name.endswith(("<listcomp>", "<dictcomp>", "<setcomp>", "<genexpr>")):
                functions.add((path, name))

    sys.setprofile(record)
    try:
        call()
    finally:
        sys.setprofile(None)
    return files, classes, functions


def assert_few(items, most, *starts):
    """Assert that there are at most so many, of those with these beginnings."""
    counted = sorted(item for item in items if not starts or item.startswith(starts))
    assert len(counted) <= most, counted


def ten_lines():
    """Those of the README, with the default fit."""
    X = line(8)
    model = CKA(X, 2 * wave(X) + X, physics=wave)
    fit(model)
    return model.predict(X)


def test_the_core_is_small():
    files, classes, functions = passed(ten_lines)
    for items, most in ((files, FILES), (classes, CLASSES), (functions, FUNCTIONS)):
        assert_few(items, most)
    texts = [path.read_text() for path in (ROOT / "core").glob("*.py")]
    assert sum(text.count("\n") for text in texts) <= CORE_LINES


def test_the_core_asks_the_physics_through_few_frames():
    depths = []

    def physics(X):
        frame, depth = sys._getframe(), 0
        while frame is not None:
            depth += frame.f_code.co_filename.startswith(str(ROOT))
            frame = frame.f_back
        depths.append(depth)
        return wave(X)

    X = line(8)
    CKA(X, 2 * wave(X), physics=physics).predict(X + 0.01)
    assert max(depths) <= 8


@cache
def parsed(path):
    """The syntax tree of a file."""
    return ast.parse(path.read_text())


def test_the_core_names_nothing_above_it():
    below = {"core", "checks", "display", "physics", "progress", "threads"}
    for path in (ROOT / "core").glob("*.py"):
        assert {name.split(".")[1] for name in imports(path)} <= below


def private_and_own(tree):
    """Private names that code reads, and names that it defines."""
    read, own = set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            (own if isinstance(node.ctx, ast.Store) else read).add(node.attr)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            own.add(node.name)
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            targets = [node.target] if isinstance(node, ast.AnnAssign) else node.targets
            own |= {target.id for target in targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in BELOW:
            read |= {*node.module.split("."), *(alias.name for alias in node.names)}
        elif isinstance(node, ast.Import) and node.names[0].name.split(".")[0] in BELOW:
            read |= {*node.names[0].name.split(".")}
    return {name for name in read if is_private(name)}, {name for name in own if is_private(name)}


def is_private(name):
    return name.startswith("_") and not name.startswith("__")


def test_no_private_name_of_another_library_is_read():
    """Rooms that extend Stable-Baselines3 and Ax are apart."""
    own = {"_replace", "_fields", "_asdict", "_make"}  # of named tuples, which are documented
    read = {}
    for path in ROOT.glob("**/*.py"):
        used, defined = private_and_own(parsed(path))
        own |= defined
        if path.parent.name not in ("ax", "rl"):
            read |= dict.fromkeys(used, path.relative_to(ROOT).as_posix())
    assert not {name: path for name, path in read.items() if name not in own}


def test_no_name_of_the_core_hides_one_of_its_bases():
    others = {*dir(torch.nn.Module()), *dir(gpytorch.models.GP()), *dir(Model)}
    for path in (ROOT / "core").glob("*.py"):
        _, own = private_and_own(parsed(path))
        assert not own & others, path.name


def csv_to_free_run(file):
    """From the log of an oscillator to scores of free runs, as the guide does it."""

    def oscillator(X):
        x, v, force = X.unbind(-1)
        return torch.stack([x + 0.1 * v, v + 0.1 * (force - x)], dim=-1)

    spec = StateSpec(["x", "v"], ["force"], step=0.1)
    records = Records.read_csv(file, spec)
    states = smooth(records, oscillator).draw()
    dynamics = LearnedDynamics(spec, oscillator)
    dynamics.update(*states.trajectories())
    windows = states.windows(10)
    return dynamics.free_run(windows.initial_states, windows.actions).score(windows.measured)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gpadjust.records.SmoothingWarning")
def test_a_log_passes_few_files_on_the_way_to_a_free_run(tmp_path):
    t = 0.1 * torch.arange(31, dtype=torch.float64)
    columns = torch.stack([t, t.cos(), -t.sin(), 0.1 * (3 * t).sin()], dim=-1)
    rows = [",".join(map(str, row)) for row in columns.tolist()]
    (tmp_path / "log.csv").write_text("\n".join(["time,x,v,force", *rows]))
    files, _, _ = passed(lambda: csv_to_free_run(tmp_path / "log.csv"))
    assert_few(files, CSV_TO_FREE_RUN)


@pytest.mark.slow
def test_a_report_passes_few_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    rows = [f"{q / 8},{28 - 2.2 * (q / 8) ** 3}" for q in range(9)]
    Path("pump.csv").write_text("\n".join(["flow [l/s],head [m]", *rows, ""]))
    Path("walked_pump.py").write_text("def head(X):\n    return 30 - 2 * X[:, 0] ** 2\n")
    import gpadjust.report.command  # not at the top: matplotlib  # noqa: F401

    given = ["--inputs", "flow", "--outputs", "head", "--physics", "walked_pump:head"]
    files, _, _ = passed(lambda: main(["report", "pump.csv", *given]))
    assert Path("report.html").exists()
    assert_few(files, REPORT + WITH_A_REPORT)
    assert_few(files, REPORT, "report", "validation")


@pytest.mark.slow
def test_an_identification_passes_few_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = [f"{k},{k / 2},{5 * 0.9**k}" for k in range(24)]
    Path("cooling.csv").write_text("\n".join(["n,t [s],excess [K]", *rows, ""]))
    import gpadjust.report.command  # not at the top: matplotlib  # noqa: F401

    given = ["--time", "t", "--states", "T=excess", "--unknown", "q = 0.5 .. 1"]
    command = ["identify", "cooling.csv", *given, "--physics", "T = q * T + 0 * time"]
    files, _, _ = passed(lambda: main(command))
    assert Path("identify.html").exists()
    assert_few(files, IDENTIFIED)


@pytest.fixture
def swing_up():
    """The cart-pole, and a task whose dynamics are fitted by default."""
    from gpadjust.systems import cart_pole

    system = cart_pole()
    return system.make(), system.task()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:A step of the last real episode")
def test_a_planned_trial_passes_few_files(swing_up):
    from gpadjust.control import MPCAgent, Planner

    plan = Planner(rounds=1, horizon=0.3, num_random=8)
    agent = MPCAgent(*swing_up, plan, first=plan, seed=0).learn(25)
    files, _, _ = passed(lambda: agent.learn(25))  # the second, in dynamics that have learnt
    assert_few(files, TRIAL)
    assert_few(files, OF_CONTROL, "control/")


@pytest.mark.slow
def test_an_iteration_of_dyna_passes_few_files(swing_up):
    from gpadjust.rl import DynaOptions, DynaSAC

    options = DynaOptions(model_episodes=2, updates_per_model_step=0.1)
    small = {"batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "device": "cpu", "seed": 0}
    agent = DynaSAC("MlpPolicy", *swing_up, options, **small).learn(25)
    files, _, _ = passed(lambda: agent.learn(25, reset_num_timesteps=False))
    assert_few(files, ITERATION)
    assert_few(files, OF_CONTROL_AND_RL, "control/", "rl/")


def test_a_formula_is_called_through_few_functions():
    physics = as_physics(wave)
    X = torch.rand(5, 1, dtype=torch.float64)
    _, _, functions = passed(lambda: physics(X))
    assert_few(functions, 6)


def imports(path):
    """The modules of the library that a file imports, annotations' included, and names of them."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gpadjust."):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_the_plan_has_each_room():
    files = ["checks", "display", "gpytorch", "progress", "threads", "words"]
    assert sorted(FLOORS) == sorted([*files, *(room.name for room in ROOMS)])


def test_imports_point_one_way():
    for path in (path for room in ROOMS for path in room.glob("**/*.py")):
        floor = path.relative_to(ROOT).parts[0]
        for module in imports(path):
            other = module.split(".")[1]
            assert FLOORS.index(other) <= FLOORS.index(floor), f"{path.name} imports {module}"


@pytest.mark.slow
def test_no_module_knows_its_owner():
    graph = {}
    for path in ROOT.glob("*/**/*.py"):
        if path.name != "__init__.py":
            module = ".".join(["gpadjust", *path.relative_to(ROOT).with_suffix("").parts])
            graph[module] = {name for name in imports(path) if name != module}
    TopologicalSorter(graph).prepare()  # a CycleError names the circle


@by_room
def test_names_and_texts_are_plain(room):
    for path in room.glob("**/*.py"):
        for node in ast.walk(parsed(path)):
            place = f"{path.name}:{getattr(node, 'lineno', 0)}"
            match node:
                case ast.Name(id=name, ctx=ast.Store()):
                    assert name not in VAGUE, f"{place}: name the content in place of {name!r}"
                case ast.Constant(value=str(text)):  # a docstring, or of a message
                    words = AVOIDED.findall(text)
                    assert not words, f"{place}: {words} in {text[:200]!r}"


def measured(path):
    """Lines of code and of comments, conditional expressions and assignments of tuples to tuples.

    Docstrings are not code; a comment for a tool is not one.
    """
    tree, code, comments, docstrings = parsed(path), set(), 0, set()
    for node in ast.walk(tree):
        value = getattr(node, "value", None) if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            docstrings |= {*range(node.lineno, node.end_lineno + 1)}
    for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
        if token.type == tokenize.COMMENT:
            comments += DIRECTIVE.match(token.string) is None
        elif token.type not in LAYOUT:
            code |= {*range(token.start[0], token.end[0] + 1)} - docstrings
    nodes = [*ast.walk(tree)]
    conditionals = sum(isinstance(node, ast.IfExp) for node in nodes)
    assignments = [node for node in nodes if isinstance(node, ast.Assign)]
    pairs = ((node.targets[0], node.value) for node in assignments)
    tuples = sum(all(isinstance(side, ast.Tuple) for side in pair) for pair in pairs)
    return len(code), comments, conditionals, tuples


@by_room
def test_there_is_one_thought_a_line_and_a_reason_beside_it(room):
    columns = zip(*(measured(path) for path in room.glob("**/*.py")), strict=True)
    code, comments, conditionals, tuples = map(sum, columns)
    assert 1000 * conditionals <= CONDITIONALS * code, f"{conditionals} in {code} lines"
    assert 1000 * tuples <= TUPLES * code, f"{tuples} in {code} lines"
    assert 100 * comments >= COMMENTS * code, f"{comments} in {code} lines"


def is_bool(annotation):
    return isinstance(annotation, ast.Name) and annotation.id == "bool"


@cache
def truths_of_the_library():
    """Functions and attributes of the library that are annotated as bool."""
    nodes = [node for path in ROOT.rglob("*.py") for node in ast.walk(parsed(path))]
    functions = {n.name for n in nodes if isinstance(n, ast.FunctionDef) and is_bool(n.returns)}
    bodies = [node.body for node in nodes if isinstance(node, ast.ClassDef)]
    fields = [line for body in bodies for line in body if isinstance(line, ast.AnnAssign)]
    return functions | {field.target.id for field in fields if is_bool(field.annotation)}


def is_truth(node, names):
    """Whether an expression is a truth value: by its form, its name, or its annotation."""
    match node:
        case ast.Constant(value=bool()) | ast.Compare() | ast.UnaryOp(op=ast.Not()):
            return True
        case ast.BoolOp(values=values):
            return all(is_truth(value, names) for value in values)
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)):
            names = {*TRUTHS.split()} | truths_of_the_library()
        case ast.Attribute(attr=name):
            names = truths_of_the_library()
        case ast.Name(id=name):
            pass
        case _:
            return False
    return name in names or name.startswith(("is_", "are_", "has_", "may_"))


def truths_in(scope):
    """Names of a function that are truth values: arguments, and what one is assigned to."""
    arguments = [node for node in ast.walk(scope) if isinstance(node, ast.arg)]
    names = {argument.arg for argument in arguments if is_bool(argument.annotation)}
    for node in ast.walk(scope):
        if isinstance(node, ast.Assign) and is_truth(node.value, names):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


def golf(tree):
    """Truth values that are multiplied, added or subtracted, or end a slice; texts multiplied."""
    scopes = [tree, *(node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))]
    for scope in scopes:
        names = truths_in(scope) if scope is not tree else set()
        for node in ast.walk(scope):
            match node:
                case ast.BinOp(left=left, op=ast.Mult() | ast.Add() | ast.Sub(), right=right):
                    sides = [left, right]
                case ast.AugAssign(op=ast.Mult() | ast.Add() | ast.Sub(), value=value):
                    sides = [value]
                case ast.Slice(lower=lower, upper=upper):
                    sides = [lower, upper]
                case _:
                    continue
            is_product = isinstance(getattr(node, "op", None), ast.Mult)
            texts = [side for side in sides if isinstance(side, ast.JoinedStr)]
            texts += [s for s in sides if isinstance(getattr(s, "value", None), str)]
            if (is_product and texts) or any(is_truth(side, names) for side in sides):
                yield node.lineno, ast.unparse(node)


def test_a_condition_is_an_if():
    """``"s" * (n != 1)`` hides an `if`; so does a number times a truth value."""
    places = {}
    for path in ROOT.rglob("*.py"):
        file = path.relative_to(ROOT).as_posix()
        for number, text in golf(parsed(path)):
            if (file, text) not in MASKS:
                places[f"{file}:{number}"] = text
    assert not places


@pytest.mark.parametrize(
    "code",
    [
        '"s" * (n != 1)',
        "[row] * bool(x)",
        'f"{x} " * n',
        "def f(static: bool): return prefix * static",
        "def f(x):\n    late = x > 1\n    return 2 * late",
        "targets[: 1 + is_log]",
        "x[:is_log]",
        "2 - model.is_fitted",
        "count += not x",
        "row * isinstance(x, int)",
    ],
)
def test_a_condition_in_arithmetic_is_seen(code):
    assert [*golf(ast.parse(code))]


@pytest.mark.parametrize("code", ["2 * n", "[0.0] * len(x)", "x[: n + 1]", "a * b.c", "f(x) - 1"])
def test_arithmetic_is_no_condition(code):
    assert not [*golf(ast.parse(code))]


@by_room
def test_no_expression_hides_another(room):
    """A conditional expression within another, or an assignment within a call."""
    hiding = [(ast.IfExp, ast.IfExp), (ast.Call, ast.NamedExpr)]
    for path in room.glob("**/*.py"):
        for outer in ast.walk(parsed(path)):
            inner = [kind for host, kind in hiding if isinstance(outer, host)]
            nodes = (node for node in ast.walk(outer) if node is not outer)
            hidden = [node.lineno for node in nodes if isinstance(node, tuple(inner))]
            assert not hidden, f"{path.name}:{hidden}"
