"""What is said of a machine whose equation lacks something, by logs whose truth is known."""

import math
from dataclasses import replace
from html import unescape

import matplotlib as mpl
import numpy as np
import pytest
import torch

from gpadjust.physics import FormulaPhysics, ODEPhysics, Unknown
from gpadjust.records import identify
from gpadjust.report import report
from gpadjust.states import StateSpec
from tests.records.machines import held, log_of, simulated

mpl.use("Agg")
pytestmark = pytest.mark.slow
STEP, ROWS = 0.1, 300
SWING = StateSpec(["angle", "rate"], ["torque"], angles=["angle"], step=STEP)
HEATED = StateSpec(["T"], ["heater"], step=STEP)
FRICTION, TAU, INERTIA = 0.25, 0.6, 0.8


def swing(friction, unknowns=None, formula="-g*sin(angle) - c*rate + torque/J"):
    """A pendulum's log, of its angle alone, identified by equations without dry friction."""

    def motion(angle, rate, torque):
        driven = -4 * math.sin(angle) - 0.3 * rate + torque / INERTIA
        return rate, driven - friction * math.tanh(rate / 0.03)

    rng = np.random.default_rng(0)
    torques = held(rng, -2, 2, ROWS)
    states = simulated(motion, [0.5, 0.0], torques, STEP)
    guesses = {"g": 3.0, "c": 0.2, "J": 1.0}
    unknowns = unknowns or {name: Unknown(x, factor=1.5) for name, x in guesses.items()}
    rates = FormulaPhysics(f"rate, {formula}", ["angle", "rate", "torque"], unknowns=unknowns)
    log = log_of(SWING, STEP, states, torques, [0.01, math.nan], rng)
    return identify(log, ODEPhysics(rates, STEP, 2), start={"rate": (0.0, 2.0)}, num_starts=1)


def heated(has_lag):
    """The log of a temperature, behind a heater that may lag, identified without the lag."""

    def flow(T, q, heat):
        return (2 * (q if has_lag else heat) - T) / 2, (heat - q) / TAU

    rng = np.random.default_rng(0)
    heats = held(rng, -2, 2, ROWS)
    states = simulated(flow, [0.0, 0.0], heats, STEP)
    unknowns = {"K": Unknown(1.5, factor=2.0), "tau": Unknown(1.0, factor=3.0)}
    rate = FormulaPhysics("(K*heater - T)/tau", ["T", "heater"], unknowns=unknowns)
    return identify(log_of(HEATED, STEP, states, heats, 0.01, rng), ODEPhysics(rate, STEP, 1))


@pytest.fixture(scope="module")
def dry():
    return swing(FRICTION)


@pytest.fixture(scope="module")
def right():
    return swing(friction=0.0)


@pytest.fixture(scope="module")
def lagging():
    return heated(has_lag=True)


def test_dry_friction_is_found_over_the_rate(dry):
    lack = dry.lack
    assert (lack.state, lack.over, lack.shape) == ("rate", "rate", "sign")
    factor = float(lack.term.removesuffix("*sign(rate)"))
    assert factor == pytest.approx(-FRICTION, rel=0.2)
    (record,) = dry.smoothed.records
    width = 0.05 * record.states[:, 1].square().mean().sqrt()
    sentence = (
        f"rate' lacks about {lack.term}, as of dry friction: try such a term. "
        f"Write F*tanh(rate/{width:.1g}) for it, with F unknown."
    )
    assert sentence in dry.advice
    other = repr(replace(lack, state="speed"))
    assert "perhaps the reaction to dry friction in rate': try such a term there. Write" in other
    assert f"rate' lacks about {lack.term}: try" in repr(replace(lack, over="torque"))
    off = lack.means + FRICTION * lack.middles.sign()
    clear = lack.middles.abs() > 0.3  # not where the rate changes its sign within a step
    assert (off[clear].abs() < 3 * lack.sd[clear]).all()
    assert (lack.means[clear].abs() > 3 * lack.sd[clear]).all()


def test_intervals_that_allow_for_a_missing_force_hold_the_damping(dry, right):
    """The damping stands for the friction; of right equations nothing changes."""
    low, high = dry.parameters.interval()
    wide_low, wide_high = dry.robust_parameters.interval()
    assert not low[1] < 0.3 < high[1]
    assert wide_low[0] < 4 < wide_high[0]
    assert wide_low[1] < 0.3 < wide_high[1]
    assert any(
        "c " in each and "Dry friction, for one, is hard to tell" in each for each in dry.advice
    )
    assert right.robust_parameters.sd[1] < 0.1 * dry.robust_parameters.sd[1]


def test_a_lag_is_found_with_what_to_do_and_is_no_yes(lagging):
    assert lagging.lack.over == "heater"
    assert 0.5 * TAU < lagging.lack.lag < 2 * TAU
    advice = " ".join(lagging.advice)
    assert "T' lacks a lag: heater acts some" in advice
    assert "Try one state more" in advice
    assert "times the noise of its sensor: it stands for what the equations lack" in advice
    # By coverage alone it would be one.
    answer, reasons = lagging.verdicts["T"]
    assert lagging.errors["identified"][0] > 2 * lagging.smoothed.noise[0]
    assert answer == "In part"
    assert any("lacks a lag" in reason for reason in reasons)


def test_of_right_equations_nothing_is_said(right):
    for found in (right, heated(has_lag=False)):
        assert found.lack is None
        assert found.combinations == []
        assert found.advice == []
        assert [answer for answer, _ in found.verdicts.values()] == ["Yes"]


def test_a_ratio_is_told_where_its_parts_are_not():
    guesses = {"k": (3.0, "N m"), "J": (1.0, "kg m2")}
    unknowns = {name: Unknown(x, factor=1.5, unit=u) for name, (x, u) in guesses.items()}
    found = swing(0.0, unknowns, "-k/J*sin(angle) - 0.3*rate + torque/0.8")
    (told,) = found.combinations
    assert (told.name, told.unit) == ("k/J", "(N m)/(kg m2)")
    low, high = told.draws.quantile(told.draws.new_tensor([0.025, 0.975])).tolist()
    assert low < 4 < high < 1.05 * low
    ends = found.parameters.interval()
    assert (ends[1] > 2 * ends[0]).all()  # of each
    assert any(each.startswith("The log tells k/J, ") for each in found.advice)


def test_better_than_the_guesses_by_chance_is_no_yes(right):
    """The intervals hold, and the guesses' errors are larger in one half, smaller in the other."""
    run, measured = right.runs["identified"], right.windows.measured
    factors = torch.full((measured.shape[1], 1), 1.35, dtype=torch.float64)
    factors[len(factors) // 2 :] = 0.8
    guessed = run._replace(mean=measured + factors * (run.mean - measured))
    found = replace(right, runs={"identified": run, "guesses": guessed})
    assert found.coverage[0] >= 0.9
    assert found.errors["identified"][0] < found.errors["guesses"][0]
    answer, reasons = found.verdicts["angle"]
    assert answer == "In part"
    assert reasons[-1] == "Its error is less by chance than that of the guesses."
    far = guessed._replace(mean=measured + 50.0)
    assert replace(right, runs={"identified": far, "guesses": run}).verdicts["angle"][0] == "No"


def test_the_figure_of_a_residual_and_the_page_that_has_it(dry, lagging, tmp_path):
    ax = dry.lack.plot(units={"rate": "rad/s"})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("rate in rad/s", "rate' lacks, in rad/s²")
    assert len(ax.lines[0].get_xdata()) == len(dry.lack.at)
    late = lagging.lack.plot()
    assert late.get_xlabel().startswith("heater, ")
    assert late.get_ylabel() == "T' lacks, in 1/s"
    text = unescape(report(dry, tmp_path / "log.html").read_text(encoding="utf-8"))
    assert f"rate' lacks about {dry.lack.term}, as of dry friction" in text
    assert "residual of rate' over rate, and its means" in text
