"""Gains, offsets and delays of sensors, and fits to free runs."""

import math

import numpy as np
import pytest
import torch

from gpadjust.physics import FormulaPhysics, ODEPhysics, Unknown
from gpadjust.records import Record, Records, check_log, identify, smooth
from gpadjust.records.sensing import Sensing
from gpadjust.states import Sensors, StateSpec
from tests.records.machines import held, log_of, simulated

STEP, ROWS, FINE = 0.1, 200, 40
SPEC = StateSpec(["x", "v"], ["u"])
PRIORS = {
    "gain": Unknown(1.0, factor=1.2),
    "offset": Unknown(0.0, sd=0.3),
    "delay": Unknown(0.25, bounds=(0.0, 0.5), unit="s"),
}
ALL = [slice(0, 40)]
START = {"v": (0.0, 1.0)}
SENSORS = Sensors(["x"], **{kind: {"x": prior} for kind, prior in PRIORS.items()})


def spring():
    unknowns = {"k": Unknown(2.25, factor=1.3), "c": Unknown(0.3, factor=1.3)}
    law = FormulaPhysics("v, u - k*x - c*v", ["x", "v", "u"], unknowns=unknowns)
    return ODEPhysics(law, STEP, 2, substeps=2)


def late_log(seed):
    """The log of a spring by a sensor with a gain, an offset and a delay, and the true numbers."""
    rng = np.random.default_rng(seed)
    k, c = np.array([2.25, 0.3]) * 1.3 ** rng.normal(size=2)
    gain, offset, delay = 1.2 ** rng.normal(), 0.3 * rng.normal(), rng.uniform(0.0, 0.5)
    forces, h = held(rng, -1, 1, ROWS), STEP / FINE
    rates = lambda x, v, u: (v, u - k * x - c * v)  # noqa: E731
    path = simulated(rates, [0.5, 0.0], np.repeat(forces, FINE), h, fine=1)[:, 0]
    late = np.interp(np.arange(ROWS) * FINE - delay / h, np.arange(len(path)), path)
    measured = gain * late + offset + 0.01 * rng.normal(size=ROWS)
    records = log_of(SPEC, STEP, np.stack([measured, late], -1), forces, [0, math.nan], rng)
    return records, [k, c, gain, offset, delay]


def test_the_outputs_near_a_path_are_those_of_the_linear_chain():
    sensing = Sensing(SENSORS, spring(), SPEC, STEP)
    assert [*sensing.unknowns][2:] == ["x_gain", "x_offset", "x_delay"]
    t = STEP * np.arange(40)
    states = np.stack([np.sin(t), np.cos(t)], -1)
    z = np.array([0.3, -0.2, 0.5, 0.7, 0.1])  # a delay of some 2.7 steps
    gain, offset, delay = sensing.values(z)[:, 0]
    outputs = sensing.outputs(states, z, ALL)
    np.testing.assert_allclose(
        outputs[9:, 0], (gain * np.sin(t - STEP * delay) + offset)[9:], atol=1e-5
    )
    assert np.array_equal(outputs[:, 1], states[:, 1])
    H, y = sensing.linearised(states, z, outputs)
    np.testing.assert_allclose(
        y[:-3], np.einsum("tij,tj->ti", H, np.hstack([states, np.tile(z, (40, 1))]))[:-3]
    )
    assert np.isnan(y[-3:, 0]).all()
    for j, step in enumerate(1e-5 * np.eye(5)):
        slope = (
            sensing.outputs(states, z + step, ALL) - sensing.outputs(states, z - step, ALL)
        ) / 2e-5
        np.testing.assert_allclose(H[:-3, 0, 2 + j], slope[3:, 0], atol=1e-6)
    corrected = sensing.corrected(outputs, z, ALL)
    np.testing.assert_allclose(corrected[9:-3, 0], np.sin(t)[9:-3], atol=2e-3)  # linear in between


@pytest.mark.filterwarnings("ignore::gpadjust.records.SmoothingWarning")
def test_sensors_without_unknowns_change_nothing():
    records, _ = late_log(0)
    few = {"start": START, "num_starts": 1, "max_rounds": 3}
    plain, sensed = (smooth(records, spring(), sensors=s, **few) for s in (None, Sensors(["x"])))
    assert torch.equal(plain.records.records[0].states, sensed.records.records[0].states)


@pytest.mark.slow
def test_intervals_cover_the_parameters_of_sensor_and_spring():
    covered = []
    for seed in range(20):
        records, true = late_log(seed)
        found = identify(records, spring(), start=START, sensors=SENSORS)
        low, high = found.parameters.interval()
        covered.append(((low <= torch.tensor(true)) & (torch.tensor(true) <= high)).tolist())
        gain = float(found.parameters["x_gain"].mean())
        assert float(found.smoothed.noise[0]) * gain == pytest.approx(0.01, rel=0.2)
        assert found.errors["identified"][0] < 0.015 / gain
    assert (np.mean(covered, 0) >= 0.9).all(), np.mean(covered, 0)


def test_a_log_may_tell_a_delay_or_not():
    records, _ = late_log(0)
    directions = check_log(records, spring(), start=START, sensors=SENSORS)
    assert min(direction.value for direction in directions) > 1
    (record,) = records
    still = Record(record.times, 0.0 * record.states, 0.0 * record.actions)
    *_, last = check_log(Records(still, SPEC), spring(), start=START, sensors=SENSORS)
    assert abs(last.weights["x_offset"]) < 0.1
    assert last.value < 1e-6


def room_log(seed, has_walls):
    """CO2 in a room by its occupancy, every 5 min, with walls that take some and give it back."""
    rng, people = np.random.default_rng(seed), []
    while len(people) < 1200:
        people += [1.0] * rng.integers(3, 40) + [0.0] * rng.integers(6, 80)
    people = np.array(people[:1200])

    def rates(level, walls, there):
        flow = has_walls * (level - walls) / 60
        return 8.0 * there - (level - 420.0) / 120 - flow, flow / 10

    states = simulated(rates, [420.0, 420.0], people, 5.0, fine=5)
    return log_of(StateSpec(["C"], ["there"]), 5.0, states, people, 4.0, rng)


def room():
    unknowns = {name: Unknown(guess, factor=1.5) for name, guess in (("g", 7.0), ("tau", 100.0))}
    unknowns["c0"] = Unknown(400.0, sd=30.0)
    law = FormulaPhysics("g*there - (C - c0)/tau", ["C", "there"], unknowns=unknowns)
    return ODEPhysics(law, 5.0, 1)


@pytest.mark.slow
def test_free_runs_are_advised_where_something_slow_is_lacking_and_equal_where_nothing_is():
    found = identify(room_log(0, has_walls=False), room())
    other = found.by_free_runs
    torch.testing.assert_close(other.parameters.center, found.parameters.center, rtol=1e-3, atol=0)
    assert other.errors["identified"] == pytest.approx(found.errors["identified"], rel=1e-3)
    assert other.by_free_runs is None
    assert not any("free runs" in sentence for sentence in found.advice)
    lacking = identify(room_log(0, has_walls=True), room())
    (advice,) = [text for text in lacking.advice if "by_free_runs" in text]
    assert "what it lacks lasts longer than a step" in advice
    assert lacking.coverage[0] < 0.6 < 0.75 < lacking.by_free_runs.coverage[0]
