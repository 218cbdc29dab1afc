"""A machine by its log: what is held out, what is compared with it, and what is said of it."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from gpadjust.control import MPC, Planner
from gpadjust.physics import FormulaPhysics, FunctionPhysics, ODEPhysics, Unknown
from gpadjust.records import Record, Records, identify
from gpadjust.records.advice import on_actions, on_outliers, on_turns
from gpadjust.states import StateSpec

STEP, TRUE = 0.1, 2.25
SPEC = StateSpec(["x", "v"], ["u"], step=STEP)
START = {"v": (0.0, 2.0)}
quickly = partial(identify, start=START, num_starts=1)


def spring(prior=None, step=STEP):
    """A mass on a spring; with a prior its stiffness is unknown."""
    unknowns = {} if prior is None else {"k": prior}
    formula = f"v, u - {'k' if unknowns else TRUE} * x"
    return ODEPhysics(FormulaPhysics(formula, ["x", "v", "u"], unknowns=unknowns), step, 2)


def oscillation(rows, noise=0.02, seed=0, known=("x",)):
    """A record of the spring under an alternating force, in its own steps."""
    generator = torch.Generator().manual_seed(seed)
    force = torch.rand(rows, 1, generator=generator, dtype=torch.float64) - 0.5
    state, states = torch.tensor([[1.0, 0.0]], dtype=torch.float64), []
    for u in force:
        states.append(state)
        state = spring()(torch.cat([state, u[None]], -1))
    errors = noise * torch.randn(rows, 2, generator=generator, dtype=torch.float64)
    states = torch.cat(states) + errors
    states[:, [name not in known for name in ("x", "v")]] = torch.nan
    return Record(STEP * torch.arange(rows, dtype=torch.float64), states, force)


@pytest.fixture(scope="module")
def found():
    return quickly(Records(oscillation(121), SPEC), spring(Unknown(1.5, factor=1.5, unit="1/s²")))


@pytest.mark.slow
def test_parameters_noise_and_a_free_run_that_errs_by_the_noise(found):
    low, high = found.parameters.interval()
    assert low < TRUE < high < low + 0.2
    assert float(found.smoothed.noise[0]) == pytest.approx(0.02, rel=0.25)
    assert found.hidden == ["v"]
    errors = {name: error.tolist() for name, error in found.errors.items()}
    assert errors["identified"][0] < 0.04
    assert min(errors["guesses"][0], errors["persistence"][0]) > 0.2
    assert all(math.isnan(error[1]) for error in errors.values())  # nobody knows
    assert found.coverage[0] > 0.85
    assert found.advice == []
    head, names, stiffness, columns, position, rate = repr(found).splitlines()
    assert head == "Identification by 90 steps, 30 held out"
    assert names.split() == ["mean", "95", "%", "interval", "prior", "unit"]
    assert stiffness.endswith("1.5, factor 1.5  1/s²")
    assert columns.split("  ")[-1] == "in 95 %"
    assert [*errors][:2] == ["identified", "guesses"]
    assert position.split()[3:5] == [f"{error[0]:.3g}" for error in [*errors.values()][:2]]
    assert rate.split()[:2] == ["v", "hidden"]


@pytest.mark.slow
def test_what_is_held_out_is_not_learnt_from(found):
    """Another end of the log changes neither states nor parameters, and is followed as badly."""
    record = oscillation(121)
    record.states[91:] += 1.0
    other = quickly(Records(record, SPEC), spring(Unknown(1.5, factor=1.5)))
    assert found.windows.measured.shape == (1, 30, 2)
    torch.testing.assert_close(other.parameters.mean, found.parameters.mean)
    torch.testing.assert_close(other.runs["identified"].mean, found.runs["identified"].mean)
    assert other.errors["identified"][0] > 0.9
    (advice,) = [sentence for sentence in other.advice if "cover 0 % of what was held" in sentence]
    assert "the physics lacks something whose errors last longer" in advice


@pytest.mark.slow
def test_functions_of_the_dynamics_have_parameters_of_their_own(found):
    at_rest = torch.tensor([[1.0, 0.0]], dtype=torch.float64).expand(300, -1, -1)
    functions = found.dynamics.sample_functions(300, seed=1)
    ends = functions(at_rest, found.windows.actions[:, 0])
    spread = ends[:, 0, 1].std() / STEP  # v changes by the stiffness times the step
    assert float(spread) == pytest.approx(float(found.parameters.sd[0]), rel=0.1)


@pytest.mark.slow
def test_several_records_and_gaps_each_have_an_end():
    """And a physics without unknown parameters is judged, too."""
    long, other, short = oscillation(61), oscillation(61, seed=1), oscillation(12, seed=2)
    times = long.times.clone()
    times[40:] += 1.0  # stretches of 39 and 20 steps
    records = Records([Record(times, long.states, long.actions), other, short], SPEC)
    found = quickly(records, spring(), held_out=0.25)
    assert found.windows.measured.shape == (2, 15, 2)  # the others have less than twice as many
    assert [len(record.times) for record in found.smoothed.records] == [25, 21, 46, 12]
    assert found.parameters is None
    assert [*found.errors] == ["identified", "persistence"]


def test_a_step_of_many_samples_follows_the_action_of_each():
    """Force that changes within a step; its mean alone would give another stiffness."""
    record = oscillation(201, noise=0.002)
    records = Records(record, StateSpec(["x", "v"], ["u"]))
    found = quickly(records, spring(Unknown(2.0, factor=1.2)), 5 * STEP, held_out=0.2)
    low, high = found.parameters.interval(0.99)
    assert low < TRUE < high
    assert high - low < 0.05
    assert float(found.smoothed.noise[0]) == pytest.approx(0.002, rel=0.35)
    assert found.step == pytest.approx(STEP)
    assert found.windows.actions.shape == (1, 40, 1)
    known = ~found.windows.measured[0, :, 0].isnan()
    assert known.nonzero().flatten().tolist() == [*range(4, 40, 5)]
    assert found.errors["identified"][0] < 0.01
    assert not any("averaged" in each for each in found.advice)


def test_advice_on_parameters():
    def of_two(X, p):
        x, v, u = X.unbind(-1)
        return torch.stack([x + STEP * v, v + STEP * (u - p.k * x) + 0 * p.idle], -1)

    unknowns = {"k": Unknown(1.0, factor=1.2), "idle": Unknown(1.0, sd=1.0)}
    physics = FunctionPhysics(of_two, unknowns=unknowns)
    found = quickly(Records(oscillation(80), SPEC), physics)
    told = " ".join(found.advice)
    assert "hardly constrains idle" in told
    assert "k is" in told
    assert "standard deviations of its prior from its guess" in told
    # Where a parameter is not told, and no lack is shown, low coverage has no other cause.
    assert found.lack is None
    shifted = found.windows._replace(measured=found.windows.measured + 1.0)
    told = " ".join(replace(found, windows=shifted).advice)
    assert "shows no lack of the physics, and does not tell idle" in told
    assert "sign or unit wrong" not in told


def test_the_center_of_a_ridge_judges():
    """Only the product of two parameters is known: the run by their means is far off."""
    unknowns = {name: Unknown(1.0, factor=3.0) for name in "ab"}
    rates = FormulaPhysics("v, u - a * b * x", ["x", "v", "u"], unknowns=unknowns)
    found = quickly(Records(oscillation(80), SPEC), ODEPhysics(rates, STEP, 2))
    assert found.parameters.mean.prod() > 1.5 * TRUE
    assert found.parameters.center.prod() == pytest.approx(TRUE, rel=0.05)
    state, path = found.windows.initial_states, []
    for action in found.windows.actions.unbind(1):
        state = found.dynamics.predict(state, action).mean
        path.append(state)
    torch.testing.assert_close(found.runs["identified"].mean, torch.stack(path, 1))
    assert found.errors["identified"][0] < 0.04


@pytest.mark.slow
def test_actions_that_vary_within_a_step_are_said():
    record = oscillation(61)
    records = Records(record, StateSpec(["x", "v"], ["u"], step=2 * STEP))
    (told, *_) = quickly(records, spring(Unknown(1.5, factor=1.5), 2 * STEP)).advice
    assert "The actions vary within a step of 2 samples, over which they are averaged" in told
    record.actions[1::2] = record.actions[:-1:2]
    assert not on_actions(records, 2 * STEP)


def alone(x, spec=SPEC):
    """Records of the first state alone, at even times."""
    states = torch.stack([x, torch.full_like(x, torch.nan)], -1)
    return Records(Record(0.1 * torch.arange(len(x)).double(), states, 0 * x.unsqueeze(-1)), spec)


def test_an_angle_that_jumps_by_a_turn_is_said():
    angled = StateSpec(["x", "v"], ["u"], angles=["x"], step=STEP)
    for turn, way in ((2 * math.pi, ""), (360.0, "convert it to rad, and ")):
        angle = (0.01 * turn * torch.arange(100).double() + 0.4 * turn) % turn
        sentence = f"x jumps by a turn: if it is an angle, {way}add it to `angles`."
        assert on_turns(alone(angle)) == [sentence]
        assert not on_turns(alone(angle, angled))


def test_a_row_that_is_far_off_both_neighbours_is_said():
    good = oscillation(121, known=("x", "v"))
    states = good.states.clone()
    states[7, 0] += 50.0
    states[9:, 1] += 50.0  # a jump, which stays, and a gap
    states[20, 1] = torch.nan
    (sentence,) = on_outliers(Records(Record(good.times, states, good.actions, name="arm"), SPEC))
    assert sentence.startswith("x is far off both neighbours")
    assert "in row 7 of 'arm': one such" in sentence
    assert not on_outliers(Records(good, SPEC))
    # Counts of an encoder that stand still most of the time; an angle, at half a turn.
    counts = states.new_zeros(121, 2)
    counts[::10, 0] = 1.0
    counts[:, 1] = math.pi - 0.01
    counts[::2, 1] *= -1
    angled = StateSpec(["x", "v"], ["u"], angles=["v"], step=STEP)
    assert not on_outliers(Records(Record(good.times, counts, good.actions), angled))


def test_a_speed_that_steps_by_360_has_no_turns():
    t = 0.1 * torch.arange(100).double()
    rises = 400.0 * (1 - (-(t - 2).clamp_min(0.0) / 0.05).exp())  # by 346 in a step, and on
    swings = 1500 * (2 * torch.pi * t / 3.9).sin()  # by 240 in a step; one step of 360
    swings[50:] += 360 - (swings[50] - swings[49])
    for speed in (rises, swings):
        assert ((speed.diff().abs() / 360 - 1).abs() < 0.12).any()
        assert not on_turns(alone(speed))


@pytest.mark.slow
def test_its_task_has_the_step_and_the_range_of_the_log(found):
    def reward(states, actions, following):
        return -following[:, 0].square()

    task = found.task(reward, episode_length=40)
    assert (task.dynamics.spec.step, task.episode_length) == (STEP, 40)
    (record,) = found.smoothed.records
    low, high = record.states.amin(0), record.states.amax(0)
    torch.testing.assert_close(task.state_bounds, torch.stack([2 * low - high, 2 * high - low]))
    assert found.task(reward, state_bounds=None).state_bounds is None
    # The rate is hidden from the controller, too.
    assert (task.sensors.outputs, [*task.sensors.noise]) == (("x",), ["x"])
    controller = MPC(task, [[-2.0], [2.0]], Planner(horizon=5 * STEP, num_random=32))
    state, path = torch.tensor([[0.5, 0.0]], dtype=torch.float64), []
    for _ in range(40):
        force = torch.as_tensor(controller.step(state[0, :1]))
        state = spring()(torch.cat([state, force[None]], -1))
        path.append(float(state[0, 0]))
    assert max(map(abs, path[-10:])) < 0.1


@pytest.mark.slow
def test_a_search_that_did_not_settle_is_never_yes(found):
    assert found.smoothed.is_settled
    assert found.verdicts["x"][0] == "Yes"
    other = replace(found, smoothed=replace(found.smoothed, is_settled=False))
    assert other.advice[0].startswith("The search for states and parameters did not settle")
    assert other.verdicts["x"] == ("In part", [*found.verdicts["x"][1], other.advice[0]])


def test_what_a_task_learns_leaves_the_identification():
    found = quickly(Records(oscillation(61, known=("x", "v")), SPEC), spring(Unknown(1.5, sd=0.5)))
    before = found.parameters.mean.clone()
    task = found.task(lambda states, actions, following: -following[:, 0].square())
    states, actions = found.windows.initial_states.repeat(9, 1), torch.zeros(9, 1).double()
    task.dynamics.update(states, actions, states + 0.5)
    assert not torch.equal(task.dynamics.physics_parameters.mean, before)
    assert torch.equal(found.dynamics.physics_parameters.mean, before)
