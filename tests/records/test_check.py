"""What a log can tell, before a fit: by sensitivities of free runs."""

import math

import numpy as np
import pytest

from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.records import Record, Records, check_log
from gpadjust.records.check import Direction
from gpadjust.states import StateSpec

STEP, ROWS = 0.1, 60
SPEC = StateSpec(["x"], ["u"])
A, B = Unknown(0.9, sd=0.1), Unknown(0.5, sd=0.2)


def log(actions, seed=0):
    """A measured state that decays, and is driven by actions."""
    rng, x, states = np.random.default_rng(seed), 1.0, []
    for u in actions:
        states.append(x + 0.01 * rng.normal())
        x = 0.9 * x + 0.5 * u
    times = STEP * np.arange(len(actions))
    return Records(Record(times, np.array(states)[:, None], actions[:, None]), SPEC)


def test_a_list_of_directions_is_short():
    weights = {"a": 0.8, "b": -0.6, **{f"c{i}": 0.01 for i in range(50)}}
    directions = [Direction(weights, 12.345, ""), Direction(weights, 0.1, "A square wave.")]
    assert str(directions) == "[Direction(0.80 a -0.60 b: 12.3), Direction(0.80 a -0.60 b: 0.1)]"


def driven(X, p):
    return (p.a * X[:, 0] + p.b * X[:, 1]).unsqueeze(-1)


def test_singular_values_are_those_of_free_runs():
    actions = np.random.default_rng(1).uniform(-1, 1, ROWS)
    records = log(actions)
    measured = records.records[0].states[:, 0].numpy()
    variance = (np.diff(measured, 3) ** 2).mean() / 20

    # Along the measured states, as the first guess of a path is: x' = a x + b u + (x - x_t) dx'/dx
    da, db, dfirst = np.zeros((3, ROWS))
    dfirst[0] = 1
    for t in range(ROWS - 1):
        da[t + 1] = 0.9 * da[t] + 0.1 * measured[t]
        db[t + 1] = 0.9 * db[t] + 0.2 * actions[t]
        dfirst[t + 1] = 0.9 * dfirst[t]
    J = np.stack([da, db, dfirst], -1)
    whole = J.T @ J / variance
    prior = 1 / (10 * measured.std()) ** 2
    left = whole[:2, :2] - np.outer(whole[:2, 2], whole[2, :2]) / (whole[2, 2] + prior)
    expected = np.sqrt(np.linalg.eigvalsh(left)[::-1])
    found = check_log(records, FunctionPhysics(driven, unknowns={"a": A, "b": B}))
    assert [each.value for each in found] == pytest.approx(expected.tolist(), rel=0.01)
    for each in found:
        assert math.hypot(*each.weights.values()) == pytest.approx(1)
        assert "The log tells" in str(each)


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
    check_log(log(np.random.default_rng(1).uniform(-1, 1, ROWS)), physics)
    assert sum(calls) <= 10 * 2 * ROWS  # evaluations of f_p in all, for two parameters


def test_an_input_that_tells_a_sum_alone_is_not_named():
    """Each of two parameters moves the measurements with such an input, and neither is known."""

    def summed(X, p):
        return (0.9 * X[:, 0] + (p.a + p.b) * X[:, 1]).unsqueeze(-1)

    physics = FunctionPhysics(summed, unknowns={"a": B, "b": B})
    for direction in check_log(log(np.zeros(ROWS)), physics):
        assert direction.value < 1e-3
        assert direction.input == "None of the inputs that were tried does."
