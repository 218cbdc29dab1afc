"""An external program as physics."""

import sys
import time

import pytest
import torch

from gpadjust import FunctionPhysics, PhysicsError, SubprocessPhysics, Unknown
from tests.systems import line, refused

LAW = """
import sys, pathlib
t, k = map(float, sys.argv[1:3])
if t > 2:
    print("no solution at this t", file=sys.stderr)
    sys.exit(3)
print(k * t**2, t)
"""


@pytest.fixture
def law(tmp_path):
    (tmp_path / "law.py").write_text(LAW)
    return [sys.executable, str(tmp_path / "law.py")]


K = {"k": Unknown(4.0, sd=1.0)}


def test_placeholders_are_inputs_and_unknown_parameters(law):
    by_name = SubprocessPhysics([*law, "{t}", "{k}"], names=["t"], unknowns=K)
    by_number = SubprocessPhysics([*law, "{0}", "{1:.1f}"])
    X = 0.1 + line(3)
    expected = torch.cat([5 * X**2, X], dim=-1)
    torch.testing.assert_close(by_name(X, torch.tensor([5.0]).double()), expected)
    torch.testing.assert_close(by_number(torch.cat([X, 0 * X + 5.04], dim=-1)), expected)
    assert by_name.name.startswith("python")
    X = torch.rand(4, 1, dtype=torch.float64)
    assert torch.equal(SubprocessPhysics([*law, "{0}", "1"])(X)[:, 1:], X)  # all digits


def test_standard_input_and_parameters(law):
    program = "import sys; print('result:', 2 * float(sys.stdin.read().split('=')[1]))"
    parse = {"parse": lambda text: float(text.removeprefix("result:"))}
    physics = SubprocessPhysics([*PYTHON, program], names=["T"], stdin="T = {T}", **parse)
    assert physics(torch.tensor([[1.5]]).double()).item() == 3.0
    one = {"names": ["t"], "parse": lambda text: float(text.split()[0])}
    physics = SubprocessPhysics([*law, "{t}", "{k}"], unknowns=K, **one)
    exact = FunctionPhysics(lambda X, p: p.k * X[:, 0] ** 2, unknowns=K)
    t, parameters = 0.5 + line(3), torch.tensor([[4.905], [4.0]]).double()
    torch.testing.assert_close(physics.or_nan(t, parameters), exact(t, parameters))


PYTHON = [sys.executable, "-c"]
REFUSED = [
    (PhysicsError, "No such file or directory: 'no_such_program'", ["no_such_program", "{0}"], {}),
    (PhysicsError, "could not convert string to float: 'do'", [*PYTHON, "print('do')"], {}),
    (PhysicsError, r"expected a scalar or outputs.*found \(0,\)", [*PYTHON, ""], {}),
    (PhysicsError, "names of all columns", ["prog", "{T}"], {"names": ["T", "p"]}),
    (TypeError, r"shlex\.split", "prog {T}", {}),
    (
        ValueError,
        r"are \['T'\]; expected inputs, which are names=\['t'\]",
        ["prog", "{T}"],
        {"names": ["t"]},
    ),
    (ValueError, "Single '{' encountered", ["prog", "{"], {}),
    (ValueError, r"are \[\]; expected.* unknown parameter, \['k'\]", ["prog"], {"unknowns": K}),
]


def test_failures_and_bad_input(law):
    physics = SubprocessPhysics([*law, "{0}", "1"])
    with pytest.raises(PhysicsError, match="no solution at this t") as caught:
        physics(torch.tensor([[1.0], [3.0]]).double())
    assert caught.value.rows == (1,)
    assert physics.or_nan(torch.tensor([[3.0], [1.0]]).double())[1].isfinite().all()
    for error, words, command, options in REFUSED:
        with pytest.raises(error, match=words):
            SubprocessPhysics(command, **options)(line(1))


@pytest.mark.slow
def test_a_run_that_takes_too_long_is_ended_with_all_that_it_started(tmp_path):
    late = tmp_path / "late"
    child = f"import time; time.sleep(3); open({str(late)!r}, 'w')"
    program = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    physics = SubprocessPhysics([sys.executable, "-c", program], timeout=1.0)
    begin = time.perf_counter()
    refused(PhysicsError, r"timed out after 1\.0 seconds", physics, line(1))
    assert time.perf_counter() - begin < 2.5
    time.sleep(2.5)
    assert not late.exists()
