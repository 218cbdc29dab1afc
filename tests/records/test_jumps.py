"""A physics that jumps, as dry friction by sign(): its slopes, and what an identification says."""

import math

import numpy as np
import pytest
import torch

from gpadjust.physics import FormulaPhysics, FunctionPhysics, ODEPhysics, Unknown
from gpadjust.records import Record, Records, identify, smooth
from gpadjust.records.chain import chain_of
from gpadjust.states import StateSpec

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
    volts = np.repeat(rng.uniform(-2, 2, ROWS // 8), 8)
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
    measured = np.array(angles) + 0.01 * rng.standard_normal(ROWS)
    states = np.stack([measured, np.full(ROWS, math.nan)], -1)
    return Records(Record(STEP * np.arange(ROWS), states, volts[:, None]), SPEC)


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


@pytest.fixture
def of_either_sign():
    """A decay whose rate is a square."""

    def decays(X, p):
        return ((1 - 0.1 * p.root**2) * X[:, 0]).unsqueeze(-1)

    t = torch.arange(60, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    x = 0.96 ** t.unsqueeze(-1) + 1e-3 * torch.randn(60, 1, generator=generator).double()
    records = Records(Record(t, x, torch.zeros_like(x)), StateSpec(["x"], ["none"]))
    prior = Unknown(0.2, sd=0.6)  # the truth is 0.63, or less likely -0.63
    return records, FunctionPhysics(decays, unknowns={"root": prior})


def test_an_end_as_likely_as_the_best_is_a_rival(of_either_sign):
    records, physics = of_either_sign
    assert smooth(records, physics, num_starts=1).rival is None
    found = identify(records, physics, num_starts=6)
    (value,) = found.smoothed.rival.tolist()
    assert abs(value + float(found.parameters["root"].mean())) < 0.02
    (sentence,) = [each for each in found.advice if each.startswith("Another start ended at root")]
    assert "about as likely" in sentence
