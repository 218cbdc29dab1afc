"""What is said of a machine whose equation lacks something, by logs whose truth is known."""

import math
from dataclasses import replace
from html import unescape

import matplotlib as mpl
import pytest
import torch

from gpadjust.physics import FormulaPhysics, ODEPhysics, Unknown
from gpadjust.records import Record, Records, identify
from gpadjust.report import report
from gpadjust.states import StateSpec

mpl.use("Agg")
pytestmark = pytest.mark.slow
STEP, ROWS, FINE = 0.1, 300, 20
SWING = StateSpec(["angle", "rate"], ["torque"], angles=["angle"], step=STEP)
HEATED = StateSpec(["T"], ["heater"], step=STEP)
FRICTION, TAU, INERTIA = 0.25, 0.6, 0.8


def held_steps(generator):
    """Actions that are held for eight steps, ``ROWS x 1``."""
    numbers = torch.rand(ROWS // 8 + 1, 1, generator=generator, dtype=torch.float64)
    return 4 * (numbers - 0.5).repeat_interleave(8, 0)[:ROWS]


def record(states, actions, generator):
    noisy = states + 0.01 * torch.randn(states.shape, generator=generator, dtype=torch.float64)
    return Record(STEP * torch.arange(ROWS, dtype=torch.float64), noisy, actions)


def swing(friction, unknowns=None, formula="-g*sin(angle) - c*rate + torque/J"):
    """A pendulum's log, of its angle alone, identified by equations without dry friction."""
    generator = torch.Generator().manual_seed(0)
    torques, states, a, v = held_steps(generator), [], 0.5, 0.0
    for torque in torques[:, 0].tolist():
        states.append([a, v])
        for _ in range(FINE):
            rate = -4 * math.sin(a) - 0.3 * v + torque / INERTIA
            a += STEP / FINE * v
            v += STEP / FINE * (rate - friction * math.tanh(v / 0.03))
    own = record(torch.tensor(states, dtype=torch.float64), torques, generator)
    own.states[:, 1] = math.nan
    guesses = {"g": 3.0, "c": 0.2, "J": 1.0}
    unknowns = unknowns or {name: Unknown(x, factor=1.5) for name, x in guesses.items()}
    rates = FormulaPhysics(f"rate, {formula}", ["angle", "rate", "torque"], unknowns=unknowns)
    start = {"rate": (0.0, 2.0)}
    return identify(Records(own, SWING), ODEPhysics(rates, STEP, 2), start=start, num_starts=1)


def heated(has_lag):
    """The log of a temperature, behind a heater that may lag, identified without the lag."""
    generator = torch.Generator().manual_seed(0)
    heats, states, T, q = held_steps(generator), [], 0.0, 0.0
    for heat in heats[:, 0].tolist():
        states.append([T])
        for _ in range(FINE):
            q += STEP / FINE * (heat - q) / TAU
            T += STEP / FINE * (2 * (q if has_lag else heat) - T) / 2
    unknowns = {"K": Unknown(1.5, factor=2.0), "tau": Unknown(1.0, factor=3.0)}
    rate = FormulaPhysics("(K*heater - T)/tau", ["T", "heater"], unknowns=unknowns)
    own = record(torch.tensor(states, dtype=torch.float64), heats, generator)
    return identify(Records(own, HEATED), ODEPhysics(rate, STEP, 1))


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


def test_a_lag_is_found_with_what_to_do(lagging):
    assert lagging.lack.over == "heater"
    assert 0.5 * TAU < lagging.lack.lag < 2 * TAU
    told = " ".join(lagging.advice)
    assert "T' lacks a lag: heater acts some" in told
    assert "Try one state more" in told
    assert "times the noise of its sensor: it stands for what the equations lack" in told


def test_errors_with_a_cause_are_no_yes(lagging):
    """Half of them were, by coverage alone."""
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
    worse = replace(
        right, runs={"identified": guessed._replace(mean=measured + 50.0), "guesses": run}
    )
    assert worse.verdicts["angle"][0] == "No"


def test_the_figure_of_a_residual(dry, lagging):
    ax = dry.lack.plot(units={"rate": "rad/s"})
    assert ax.get_ylabel() == "rate' lacks, in rad/s²"
    assert ax.get_xlabel() == "rate in rad/s"
    assert len(ax.lines[0].get_xdata()) == len(dry.lack.at)
    late = lagging.lack.plot()
    assert late.get_xlabel().startswith("heater, ")
    assert late.get_ylabel() == "T' lacks, in 1/s"


def test_the_page_has_the_sentence_and_the_figure(dry, tmp_path):
    text = unescape(report(dry, tmp_path / "log.html").read_text(encoding="utf-8"))
    assert f"rate' lacks about {dry.lack.term}, as of dry friction" in text
    assert "residual of rate' over rate, and its means" in text
