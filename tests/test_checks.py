"""The checks that all rooms share: what they let pass, what they refuse, and in which words."""

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch

from gpadjust import checks
from tests.systems import refused

NAN, INF = math.nan, math.inf
ONES = torch.ones(2, 3)
BOUNDS = torch.tensor([[0.0], [1.0]], dtype=torch.float64)


@pytest.mark.parametrize(("limits", "inside", "outside", "words"), [
    ({}, (-1e9, 1e9), (INF, NAN), "finite"),
    ({"above": 0}, (1e-9,), (0, -1, INF), "finite and above 0"),
    ({"least": 0}, (0, 5), (-1e-9, NAN), "finite and at least 0"),
    ({"least": 0, "most": 1}, (0, 1), (-0.1, 1.1, NAN), "at least 0 and at most 1"),
    ({"above": 0, "below": 1}, (0.5,), (0, 1, NAN), "above 0 and below 1"),
])  # fmt: skip
def test_ranges_of_numbers(limits, inside, outside, words):
    for value in inside:
        number = checks.checked_number("x", value, **limits)
        assert (number, type(number)) == (value, float)
    for value in outside:
        words_of = f"x must be {words}; found {value}"
        refused(ValueError, words_of, checks.checked_number, "x", value, **limits)


def test_right_values_pass():
    for value in (3, np.int64(3), torch.tensor(3)):
        number = checks.checked_whole("n", value, 3)
        assert (number, type(number)) == (3, int)
    assert checks.checked_whole("n", -5) == -5
    checks.check_columns("s", torch.ones(2, 4), 3, more=True)
    checks.check_observed("Y", torch.tensor([[1.0, NAN]]))
    assert checks.checked_options("options", None, ("a",)) == {}
    assert checks.checked_options("options", {"a": 1}, ("a",)) == {"a": 1}
    assert checks.finite_array([1, 2], (2,)).tolist() == [1.0, 2.0]
    assert checks.checked_bounds("b", [[0, 1], [2, 3]], 2).tolist() == [[0.0, 1.0], [2.0, 3.0]]
    assert checks.checked_points("X", [[0], [1]], 1, BOUNDS).tolist() == [[0.0], [1.0]]


def test_tensors_are_copies_in_double_precision():
    expected = torch.tensor([1, 2], dtype=torch.float64)
    for values in ([1, 2], np.array([1, 2]), torch.tensor([1, 2]), [Fraction(1), Fraction(2)]):
        assert torch.equal(checks.checked_tensor("x", values), expected)
    checks.checked_tensor("x", expected)[0] = 5
    assert expected[0] == 1


REFUSED = {
    checks.checked_whole: [
        *((TypeError, "n must be a whole number; found", "n", value)
          for value in (1.0, "1", None, True, torch.ones(2))),
        (ValueError, "n must be at least 2; found 1", "n", 1, 2),
    ],
    checks.checked_number: [
        (TypeError, "x must be a number", "x", value)
        for value in ("1", None, True, 1j, torch.ones(()))
    ],
    checks.check_level: [
        *((ValueError, "level must be", level) for level in (95, 0)),
        *((TypeError, "level must be", level) for level in ("95 %", True)),
    ],
    checks.check_switch: [(TypeError, "on must be True or False; found 1", "on", 1)],
    checks.check_choice: [
        (ValueError, "Unknown way 'up'; use 'in' or 'out'", "way", "up", ("in", "out"))
    ],
    checks.checked_options: [
        (TypeError, "options must be a dictionary, which may hold 'a'", "options", ["a"], ("a",)),
        (ValueError, "Unknown option 'b'; the known ones: 'a'", "options", {"b": 1}, ("a",)),
    ],
    checks.checked_tensor: [
        (TypeError, "Expected x to be real numbers", "x", values)
        for values in ([1j], ["1"], [None], torch.ones(2, dtype=torch.complex64), [[1], [1, 2]])
    ],
    checks.checked_bounds: [
        *((ValueError, "b of shape 2 x d, the lower ones", "b", bounds)
          for bounds in ([0, 1], [[0], [1], [2]], [[], []])),
        (ValueError, r"b of shape 2 x 3, .* got \(2, 1\)", "b", [[0], [1]], 3),
        *((ValueError, "finite b, each lower one below its upper one", "b", [[0.0], [upper]])
          for upper in (0.0, -1.0, INF, NAN)),
    ],
    checks.checked_points: [
        (ValueError, r"X of shape n x 2, .* got \(1, 1\)", "X", [[0.0]], 2),
        (ValueError, "X to be finite", "X", [[NAN]], 1),
        (ValueError, r"X within the bounds .*, got \[2\.0\]", "X", [[0.5], [2.0]], 1, BOUNDS),
    ],
    checks.check_columns: [
        (ValueError, r"s of shape .* x 4, got", "s", ONES, 4),
        (ValueError, "s of shape .* x 4 or more", "s", ONES, 4, True),
        (ValueError, "s of shape .* x 2", "s", ONES, 2),
        *((TypeError, r"s as a floating-point tensor, .*torch.as_tensor\(s", "s", wrong, 1)
          for wrong in ([[1.0]], ONES.long())),
    ],
    checks.check_finite: [
        (ValueError, r"X to be finite, found NaN .* 1 of 2 rows \(row 1\)", "X",
         torch.tensor([[1.0, 1.0], [NAN, 1.0]])),
    ],
    checks.check_observed: [
        (ValueError, r"Y to hold an observation in each row.*\(row 1\)", "Y",
         torch.tensor([[1.0, NAN], [NAN, NAN]])),
        (ValueError, r"Y to be finite, found infinity .*\(row 1\)", "Y",
         torch.tensor([[1.0, NAN], [1.0, INF]])),
    ],
}  # fmt: skip


@pytest.mark.parametrize("check", REFUSED, ids=lambda check: check.__name__)
def test_refused(check):
    for error, words, *arguments in REFUSED[check]:
        refused(error, words, check, *arguments)


def test_arrays_of_another_kind_or_shape():
    for values in ([1], [1, NAN], [1, "2"], None, [[1, 2]]):
        assert checks.finite_array(values, (2,)) is None


def test_a_warning_is_at_the_line_of_the_user():
    """However many functions of the package are between."""
    code = "from gpadjust.checks import warn\ndef inner(): warn('here')\ndef outer(): inner()\n"
    names = {}
    exec(compile(code, str(Path(checks.__file__).parent / "new.py"), "exec"), names)
    for call in ("inner", "outer"):
        with pytest.warns(UserWarning, match="here") as caught:
            names[call]()
        assert caught[0].filename == __file__
