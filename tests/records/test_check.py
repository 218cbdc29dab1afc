"""What a log can tell, before a fit: by sensitivities of free runs."""

import math

import numpy as np
import pytest

from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.records import check_log
from gpadjust.records.check import Direction
from gpadjust.states import StateSpec
from tests.records.machines import log_of

ROWS = 60
RANDOM = np.random.default_rng(1).uniform(-1, 1, ROWS)
A, B = Unknown(0.9, sd=0.1), Unknown(0.5, sd=0.2)


def log(actions):
    """A measured state that decays, and is driven by actions."""
    rng, x, states = np.random.default_rng(0), 1.0, []
    for u in actions:
        states.append([x])
        x = 0.9 * x + 0.5 * u
    return log_of(StateSpec(["x"], ["u"]), 0.1, np.array(states), actions, 0.01, rng)


def test_a_list_of_directions_is_short():
    weights = {"a": 0.8, "b": -0.6, **{f"c{i}": 0.01 for i in range(50)}}
    directions = [Direction(weights, 12.345, ""), Direction(weights, 0.1, "A square wave.")]
    assert str(directions) == "[Direction(0.80 a -0.60 b: 12.3), Direction(0.80 a -0.60 b: 0.1)]"


def driven(X, p):
    return (p.a * X[:, 0] + p.b * X[:, 1]).unsqueeze(-1)


def test_singular_values_are_those_of_free_runs():
    records = log(RANDOM)
    measured = records.records[0].states[:, 0].numpy()
    variance = (np.diff(measured, 3) ** 2).mean() / 20
    # Along the measured states, as the first guess of a path is: x' = a x + b u + (x - x_t) dx'/dx
    J = np.zeros((ROWS, 3))  # by a, b and the first state
    J[0, 2] = 1
    for t in range(ROWS - 1):
        J[t + 1] = 0.9 * J[t] + [0.1 * measured[t], 0.2 * RANDOM[t], 0]
    information = J.T @ J / variance
    prior = 1 / (10 * measured.std()) ** 2
    shared = np.outer(information[:2, 2], information[2, :2]) / (information[2, 2] + prior)
    expected = np.sqrt(np.linalg.eigvalsh(information[:2, :2] - shared)[::-1])
    directions = check_log(records, FunctionPhysics(driven, unknowns={"a": A, "b": B}))
    assert [direction.value for direction in directions] == pytest.approx(expected, rel=0.01)
    for direction in directions:
        assert math.hypot(*direction.weights.values()) == pytest.approx(1)
        assert "The log tells" in str(direction)


def test_what_no_action_moves_is_not_told_and_an_input_is_named():
    calls = []

    def counted(X, p):
        calls.append(len(X))
        return driven(X, p)

    physics = FunctionPhysics(counted, unknowns={"a": A, "b": B})
    first, last = check_log(log(np.zeros(ROWS)), physics)
    assert abs(first.weights["a"]) == pytest.approx(1)
    assert last.value < 1e-3
    assert str(last).startswith("The log cannot tell 1.00 b (singular value")
    assert "square wave of u between -1 and 1 with half a period of" in last.input
    calls.clear()
    check_log(log(RANDOM), physics)
    assert sum(calls) <= 10 * 2 * ROWS  # evaluations of f_p in all, for two parameters


def test_an_input_that_tells_a_sum_alone_is_not_named():
    """Each of two parameters moves the measurements with such an input, and neither is known."""

    def summed(X, p):
        return (0.9 * X[:, 0] + (p.a + p.b) * X[:, 1]).unsqueeze(-1)

    physics = FunctionPhysics(summed, unknowns={"a": B, "b": B})
    for direction in check_log(log(np.zeros(ROWS)), physics):
        assert direction.value < 1e-3
        assert direction.input == "None of the inputs that were tried does."
