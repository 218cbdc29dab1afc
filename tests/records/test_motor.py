"""A motor whose friction is an unknown function of its speed."""

import math

import numpy as np
import pytest
import torch

from gpadjust.export import c_source
from gpadjust.physics import FormulaPhysics, ODEPhysics, Unknown
from gpadjust.records import Record, Records, identify
from gpadjust.states import StateSpec
from tests.export.conftest import called, compiled

STEP, INERTIA, NOISE = 0.05, 0.05, 0.1  # s, kg m², rad/s
SPEC = StateSpec(["speed"], ["torque"])


def friction(speed):
    """Friction in N m: less at first, as lubrication begins (Stribeck), then more."""
    return 0.15 + 0.25 * np.exp(-((speed / 4) ** 2)) + 0.012 * speed


def motor_log(seed, length=600):
    """A log under torques that are held for 15 rows, and the speeds without noise."""
    rng = np.random.default_rng(seed)
    torques = np.repeat(rng.uniform(0.15, 0.55, size=length // 15 + 1), 15)[:length]
    speeds, speed = np.zeros(length), 6.0
    for i, torque in enumerate(torques):
        speeds[i] = speed
        for _ in range(10):

            def rate(v, torque=torque):
                return (torque - friction(max(v, 0.0)) * math.tanh(v / 0.05)) / INERTIA

            h = STEP / 10
            speed += h * rate(speed + h / 2 * rate(speed))
    measured = speeds + NOISE * rng.standard_normal(length)
    record = Record(STEP * np.arange(length), measured[:, None], torques[:, None])
    return Records(record, SPEC), speeds


def motor(**function):
    """The physics, whose friction is a constant or a function."""
    unknowns = {
        "friction": Unknown(0.3, factor=1.5, unit="N m", **function),
        "inertia": Unknown(0.04, factor=1.5, unit="kg m²"),
    }
    law = "(torque - friction * tanh(speed / 0.05)) / inertia"
    law = FormulaPhysics(law, ["speed", "torque"], unknowns=unknowns)
    return ODEPhysics(law, STEP, 1, substeps=4)


def judged(seed):
    """Identifications by a function and by a constant, and what share of the curve the band has."""
    records, speeds = motor_log(seed)
    found = identify(records, motor(function_of="speed", between=(0.0, 25.0)))
    constant = identify(records, motor())
    x = np.linspace(speeds.min(), speeds.max(), 50)
    draws = found.parameters.friction(torch.from_numpy(x)).numpy()
    low, high = np.quantile(draws, [0.025, 0.975], axis=0)
    return found, constant, np.mean((low <= friction(x)) & (friction(x) <= high))


@pytest.mark.slow
def test_a_log_shows_the_curve(tmp_path):
    shares, ratios = [], []
    for seed in range(4):
        found, constant, share = judged(seed)
        shares.append(share)
        ratios.append(float(found.errors["identified"][0] / constant.errors["identified"][0]))
        assert abs(found.parameters["inertia"].mean() - INERTIA) < 0.002
    assert np.mean(shares) >= 0.9
    assert max(ratios) < 0.5
    state, torque = torch.tensor([[7.0]]).double(), torch.tensor([[0.4]]).double()
    (moved,) = called(compiled(c_source(found, "motor"), tmp_path).motor_step, (1,), state, torque)
    torch.testing.assert_close(moved, found.dynamics.predict(state, torque).mean[0])
