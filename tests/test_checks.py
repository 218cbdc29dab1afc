"""The checks that all rooms share: what they let pass, what they refuse, and in which words."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from gpadjust.checks import (
    check_choice,
    check_columns,
    check_finite,
    check_level,
    check_observed,
    check_switch,
    checked_bounds,
    checked_number,
    checked_options,
    checked_points,
    checked_tensor,
    checked_whole,
    finite_array,
)

NAN = math.nan


def test_whole_numbers_of_each_library_are_taken():
    for value in (3, np.int64(3), torch.tensor(3)):
        found = checked_whole("n", value, 3)
        assert found == 3
        assert type(found) is int


def test_what_is_no_whole_number_or_too_small_is_refused():
    for value in (1.0, "1", None, True, torch.ones(2)):
        with pytest.raises(TypeError, match="n must be a whole number; found"):
            checked_whole("n", value)
    assert checked_whole("n", -5) == -5
    with pytest.raises(ValueError, match="n must be at least 2; found 1"):
        checked_whole("n", 1, 2)


@pytest.mark.parametrize(
    ("limits", "inside", "outside", "words"),
    [
        ({}, (-1e9, 1e9), (math.inf, NAN), "finite"),
        ({"above": 0}, (1e-9,), (0, -1, math.inf), "finite and above 0"),
        ({"least": 0}, (0, 5), (-1e-9, NAN), "finite and at least 0"),
        ({"least": 0, "most": 1}, (0, 1), (-0.1, 1.1, NAN), "at least 0 and at most 1"),
        ({"above": 0, "below": 1}, (0.5,), (0, 1, NAN), "above 0 and below 1"),
    ],
)
def test_ranges_of_numbers(limits, inside, outside, words):
    for value in inside:
        found = checked_number("x", value, **limits)
        assert found == value
        assert type(found) is float
    for value in outside:
        with pytest.raises(ValueError, match=f"x must be {words}; found {value}"):
            checked_number("x", value, **limits)


def test_what_is_no_number_is_refused():
    for value in ("1", None, True, 1j, torch.ones(())):
        with pytest.raises(TypeError, match="x must be a number"):
            checked_number("x", value)


def test_levels():
    check_level(0.95)
    for level, error in ((95, ValueError), (0, ValueError), ("95 %", TypeError), (True, TypeError)):
        with pytest.raises(error, match="level must be"):
            check_level(level)


def test_switches_choices_and_options():
    check_switch("on", False)
    with pytest.raises(TypeError, match="on must be True or False; found 1"):
        check_switch("on", 1)
    check_choice("way", "in", ("in", "out"))
    with pytest.raises(ValueError, match="Unknown way 'up'; use 'in' or 'out'"):
        check_choice("way", "up", ("in", "out"))
    assert checked_options("options", None, ("a",)) == {}
    assert checked_options("options", {"a": 1}, ("a",)) == {"a": 1}
    with pytest.raises(TypeError, match="options must be a dictionary, which may hold 'a'"):
        checked_options("options", ["a"], ("a",))
    with pytest.raises(ValueError, match="Unknown option 'b'; the known ones: 'a'"):
        checked_options("options", {"b": 1}, ("a",))


def test_tensors_are_copies_in_double_precision():
    for values in ([1, 2], np.array([1, 2]), torch.tensor([1, 2]), [Fraction(1), Fraction(2)]):
        assert torch.equal(checked_tensor("x", values), torch.tensor([1, 2], dtype=torch.float64))
    given = torch.ones(2, dtype=torch.float64)
    checked_tensor("x", given)[0] = 5
    assert given[0] == 1
    for values in ([1j], ["1"], [None], torch.ones(2, dtype=torch.complex64), [[1], [1, 2]]):
        with pytest.raises(TypeError, match="Expected x to be real numbers"):
            checked_tensor("x", values)


def test_finite_arrays_have_their_shape():
    assert finite_array([1, 2], (2,)).tolist() == [1.0, 2.0]
    for values in ([1], [1, NAN], [1, "2"], None, [[1, 2]]):
        assert finite_array(values, (2,)) is None


def test_bounds():
    assert checked_bounds("b", [[0, 1], [2, 3]], 2).tolist() == [[0.0, 1.0], [2.0, 3.0]]
    for bounds in ([0, 1], [[0], [1], [2]], [[], []]):
        with pytest.raises(ValueError, match="b of shape 2 x d, the lower ones"):
            checked_bounds("b", bounds)
    with pytest.raises(ValueError, match=r"b of shape 2 x 3, .* got \(2, 1\)"):
        checked_bounds("b", [[0], [1]], 3)
    for upper in (0.0, -1.0, math.inf, NAN):
        with pytest.raises(ValueError, match="finite b, each lower one below its upper one"):
            checked_bounds("b", [[0.0], [upper]])


def test_points():
    bounds = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    assert checked_points("X", [[0], [1]], 1, bounds).tolist() == [[0.0], [1.0]]
    with pytest.raises(ValueError, match=r"X of shape n x 2, .* got \(1, 1\)"):
        checked_points("X", [[0.0]], 2)
    with pytest.raises(ValueError, match="X to be finite"):
        checked_points("X", [[NAN]], 1)
    with pytest.raises(ValueError, match=r"X within the bounds .*, got \[2\.0\]"):
        checked_points("X", [[0.5], [2.0]], 1, bounds)


def test_columns():
    check_columns("s", torch.ones(2, 3), 3)
    check_columns("s", torch.ones(2, 4), 3, more=True)
    for columns, more, words in (
        (4, False, r"x 4, got"),
        (4, True, "x 4 or more"),
        (2, False, "x 2"),
    ):
        with pytest.raises(ValueError, match=f"s of shape .* {words}"):
            check_columns("s", torch.ones(2, 3), columns, more)
    for wrong in ([[1.0]], torch.ones(2, 3, dtype=torch.int64)):
        with pytest.raises(TypeError, match=r"s as a floating-point tensor, .*torch.as_tensor\(s"):
            check_columns("s", wrong, 1)


def test_rows_that_are_not_finite_are_named():
    values = torch.ones(3, 2)
    check_finite("X", values)
    check_observed("Y", values)
    values[1, 0] = NAN
    check_observed("Y", values)
    with pytest.raises(ValueError, match=r"X to be finite, found NaN .* 1 of 3 rows \(row 1\)"):
        check_finite("X", values)
    values[1] = NAN
    with pytest.raises(ValueError, match=r"Y to hold an observation in each row.*\(row 1\)"):
        check_observed("Y", values)
    values[2, 1] = math.inf
    with pytest.raises(ValueError, match=r"Y to be finite, found infinity .*\(row 2\)"):
        check_observed("Y", values)
