"""Friction of motors: a physics that jumps, by sign(), and an unknown function of the speed."""

import math

import numpy as np
import pytest
import torch

from gpadjust.export import c_source
from gpadjust.physics import FormulaPhysics, FunctionPhysics, ODEPhysics, Unknown
from gpadjust.records import Record, Records, identify, smooth
from gpadjust.records.chain import chain_of
from gpadjust.states import StateSpec
from tests.export.conftest import called, compiled
from tests.records.machines import held, log_of, simulated
from tests.systems import normal

STEP, ROWS, FINE = 0.05, 160, 100
SPEC = StateSpec(["angle", "speed"], ["volts"])
TRUE = {"K": 0.05, "J": 0.002, "c": 0.004, "F": 0.03}
GUESSES = {"K": 0.06, "J": 0.003, "c": 0.003, "F": 0.02}  # only ratios move the motor


def motor(friction, guesses, **options):
    unknowns = {name: Unknown(guess, factor=1.5) for name, guess in guesses.items()}
    rates = f"speed, (K*volts - c*speed - F*{friction})/J"
    formula = FormulaPhysics(rates, ["angle", "speed", "volts"], unknowns=unknowns)
    return ODEPhysics(formula, STEP, 2, **options)


def sticking(seed):
    """The log of a motor that sticks and slips, of its angle alone."""
    rng = np.random.default_rng(seed)
    volts = held(rng, -2, 2, ROWS)
    angle, speed, angles = 0.0, 0.0, []
    for u in volts:
        angles.append(angle)
        for _ in range(FINE):
            force = TRUE["K"] * u - TRUE["c"] * speed
            if speed == 0 and abs(force) <= TRUE["F"]:
                continue
            sign = np.sign(speed) or np.sign(force)
            new = speed + STEP / FINE * (force - TRUE["F"] * sign) / TRUE["J"]
            if new * speed < 0:
                new = 0.0
            angle, speed = angle + STEP / FINE * (speed + new) / 2, new
    states = np.stack([angles, angles], -1)  # without a measured speed
    return log_of(SPEC, STEP, states, volts, [0.01, math.nan], rng)


def test_the_slopes_at_a_jump_are_those_of_one_side():
    """All parameters by the same factor change nothing, so that their slopes sum to nothing."""
    physics = motor("sign(speed)", TRUE, substeps=1)
    # The second slope of Kutta's rule is where friction has all but stopped the motor.
    stops = STEP / 3 * TRUE["F"] / TRUE["J"] / (1 - STEP / 3 * TRUE["c"] / TRUE["J"])
    speeds = np.array([3.0, -2.0, stops + 1e-7, 1.0, 2.0])
    states = np.stack([np.zeros(5), speeds], -1)
    records = Records(Record(STEP * np.arange(5), states, np.zeros((5, 1))), SPEC)
    chain = chain_of(records, physics, None, None)
    slopes, is_jump = chain.slopes(chain.first_path(np.zeros(4)))
    # Of angle, speed, K, J, c and F: no volts, and so no K.
    assert is_jump[:, 2].tolist() == [False, True, False, True, True, True]
    assert not is_jump[:, :2].any()
    np.testing.assert_allclose(slopes[2:].sum(0), 0.0, atol=1e-6)
    assert abs(slopes[5, 2, 1]) < 1  # by central differences -1,000


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gpadjust.records.SmoothingWarning")
def test_a_search_among_jumps_is_no_yes_and_the_way_out_is_named():
    records = sticking(0)
    options = {"start": {"speed": (0.0, 5.0)}, "num_starts": 1}
    found = identify(records, motor("sign(speed)", GUESSES), **options)
    assert found.smoothed.jumps > 0.005
    answer, reasons = found.verdicts["angle"]
    assert answer == "In part"
    sentence = next(reason for reason in reasons if reason.startswith("The physics jumps near"))
    assert "tanh(x/d) in place of sign(x)" in sentence
    assert sentence in found.advice
    # The scale is the prior's, not one that differences across jumps made up.
    low, high = found.parameters.interval()
    assert (high > 2 * low).all()
    smooth_sign = identify(records, motor("tanh(speed/0.05)", GUESSES), **options)
    assert smooth_sign.smoothed.jumps == 0
    assert len(smooth_sign.combinations) == 3  # of four parameters, all but their scale
    for combination in smooth_sign.combinations:
        low, high = combination.draws.quantile(torch.tensor([0.005, 0.995]).double())
        assert low < TRUE[combination.first] / TRUE[combination.second] < high


def test_an_end_as_likely_as_the_best_is_a_rival():
    """Of a decay whose rate is a square."""

    def decays(X, p):
        return ((1 - 0.1 * p.root**2) * X[:, 0]).unsqueeze(-1)

    t = torch.arange(60, dtype=torch.float64)
    x = 0.96 ** t.unsqueeze(-1) + 1e-3 * normal(60, 1)
    records = Records(Record(t, x, torch.zeros_like(x)), StateSpec(["x"], ["none"]))
    prior = Unknown(0.2, sd=0.6)  # the truth is 0.63, or less likely -0.63
    physics = FunctionPhysics(decays, unknowns={"root": prior})
    assert smooth(records, physics, num_starts=1).rival is None
    found = identify(records, physics, num_starts=6)
    (value,) = found.smoothed.rival.tolist()
    assert abs(value + float(found.parameters["root"].mean())) < 0.02
    (sentence,) = [text for text in found.advice if text.startswith("Another start ended at root")]
    assert "about as likely" in sentence


def stribeck(speed):
    """Friction in N m: less at first, as lubrication begins (Stribeck), then more."""
    return 0.15 + 0.25 * np.exp(-((speed / 4) ** 2)) + 0.012 * speed


def identified(log, **function):
    """By a physics whose friction is a constant or a function."""
    unknowns = {
        "friction": Unknown(0.3, factor=1.5, unit="N m", **function),
        "inertia": Unknown(0.04, factor=1.5, unit="kg m²"),
    }
    law = "(torque - friction * tanh(speed / 0.05)) / inertia"
    law = FormulaPhysics(law, ["speed", "torque"], unknowns=unknowns)
    return identify(log, ODEPhysics(law, STEP, 1, substeps=4))


@pytest.mark.slow
def test_a_log_shows_the_curve_of_friction(tmp_path):
    inertia, shares = 0.05, []

    def rates(v, torque):
        return [(torque - stribeck(max(v, 0.0)) * math.tanh(v / 0.05)) / inertia]

    for seed in range(2):
        rng = np.random.default_rng(seed)
        torques = held(rng, 0.15, 0.55, 600, length=15)
        speeds = simulated(rates, [6.0], torques, STEP, fine=10)
        log = log_of(StateSpec(["speed"], ["torque"]), STEP, speeds, torques, 0.1, rng)
        found = identified(log, function_of="speed", between=(0.0, 25.0))
        assert found.errors["identified"][0] < 0.5 * identified(log).errors["identified"][0]
        assert abs(found.parameters["inertia"].mean() - inertia) < 0.002
        x = np.linspace(speeds.min(), speeds.max(), 50)
        draws = found.parameters.friction(torch.from_numpy(x)).numpy()
        low, high = np.quantile(draws, [0.025, 0.975], axis=0)
        shares.append(np.mean((low <= stribeck(x)) & (stribeck(x) <= high)))
    assert np.mean(shares) >= 0.9
    state, torque = torch.tensor([[7.0]]).double(), torch.tensor([[0.4]]).double()
    (moved,) = called(compiled(c_source(found, "motor"), tmp_path).motor_step, (1,), state, torque)
    torch.testing.assert_close(moved, found.dynamics.predict(state, torque).mean[0])
