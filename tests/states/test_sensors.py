"""What is measured of a state."""

import math

import pytest
import torch

from gpadjust.states import Sensors, StateSpec
from tests.systems import refused

SPEC = StateSpec(["x", "theta", "omega"], ["force"], angles=["theta"])
STATE = torch.tensor([[1.0, 0.5, 2.0]]).double()


def test_outputs_are_states_by_name_or_any_function():
    sensors = Sensors(["theta", "x"])
    values = sensors.measure(SPEC, STATE)
    assert values.tolist() == [[0.5, 1.0]]
    expected = torch.tensor([[math.sin(0.5), math.cos(0.5), 1.0]]).double()
    torch.testing.assert_close(sensors.spec(SPEC).observe(values), expected)
    height = Sensors(["height"], lambda states: states[:, 1:2].cos())
    assert height.measure(SPEC, STATE).item() == pytest.approx(math.cos(0.5))
    assert height.spec(SPEC).angles == ()
    assert height.describe() == {"outputs": ["height"], "function": True}
    guessed = Sensors(["height"], height.function, noise={"height": 0.1})
    assert guessed.describe() == {**height.describe(), "noise": {"height": 0.1}}


PAIR = Sensors(["a", "b"], lambda states: states[:, 0])
REFUSED = [
    (ValueError, "one or more", Sensors, []),
    (TypeError, "sequence of names", Sensors, "x"),
    (TypeError, "function of states; found 3", Sensors, ["x"], 3),
    (ValueError, "Unknown output 'v'", lambda: Sensors(["x"], noise={"v": 1.0})),
    (ValueError, "above 0", lambda: Sensors(["x"], noise={"x": 0.0})),
    (ValueError, r"no state 'height'.*Sensors\(names", Sensors(["height"]).spec, SPEC),
    (ValueError, r"shape 1 x 2.*found \(1,\)", PAIR.measure, SPEC, STATE),
]


def test_bad_sensors_are_refused():
    for error, words, *call in REFUSED:
        refused(error, words, *call)
