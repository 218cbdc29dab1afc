"""Which cases of tests with several parameters the quick run takes, and that it says so."""

from itertools import combinations, product
from pathlib import Path

import pytest

pytest_plugins = "pytester"

CASES = """
import pytest

@pytest.mark.parametrize("a", [1, 2, 3])
@pytest.mark.parametrize("b", "xy")
@pytest.mark.parametrize("c", [True, False])
def test_three(a, b, c):
    with open("ran", "a") as file:
        file.write(f"{a}{b}{int(c)}\\n")

@pytest.mark.parametrize("a", [1, 2])
@pytest.mark.parametrize("b", [1, 2])
def test_two(a, b):
    pass
"""


@pytest.mark.parametrize("processes", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_each_pair_of_values_runs_and_the_rest_is_named(pytester, processes):
    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text())
    pytester.makeini("[pytest]\nmarkers = slow\naddopts = -m 'not slow'")
    pytester.makepyfile(CASES)
    result = pytester.runpytest("-v", "--numprocesses", str(processes))
    ran = set((pytester.path / "ran").read_text().split())
    every = {"".join(case) for case in product("123", "xy", "01")}
    pairs = {pair for case in every for pair in combinations(enumerate(case), 2)}
    assert {pair for case in ran for pair in combinations(enumerate(case), 2)} == pairs
    assert len(ran) < len(every)
    assert result.parseoutcomes()["passed"] == len(ran) + 4
    result.stdout.fnmatch_lines([f"{len(every) - len(ran)} cases of tests with three*"])
    for a, b, c in every - ran:
        name = f"test_three[[]{bool(int(c))}-{b}-{a}]"
        result.stdout.fnmatch_lines([f"*{name}"])
