"""What is no record, no file, no step and no physics of a machine, and the errors about it."""

import math
from functools import partial

import numpy as np
import pytest
import torch

from gpadjust.physics import FunctionPhysics, ODEPhysics, PhysicsError, Unknown
from gpadjust.records import Record, Records, check_log, identify, smooth
from gpadjust.records.plots import plot_record
from gpadjust.records.smoothing import SmoothingWarning
from gpadjust.states import Sensors, StateSpec

POINT = StateSpec(["x", "v"], ["u"])
LAGGED = StateSpec(["x", "v"], ["u"], previous={"v": "x"})
READ_LAG = StateSpec(["x", "v"], ["u"], previous={"v": "x"}, physics_reads=["x", "v", "u"])
NAN = math.nan


def column(*values):
    return torch.tensor(values, dtype=torch.float64).reshape(-1, 1)


def moved(num_rows=20, step=0.1, name="r", **changed):
    """A record of a body that oscillates."""
    times = step * torch.arange(num_rows, dtype=torch.float64)
    parts = {"times": times, "states": torch.stack([times.sin(), times.cos()], dim=-1)}
    return Record(**{**parts, "actions": -times.sin().unsqueeze(-1), **changed}, name=name)


def body(X):
    x, v, u = X.unbind(-1)
    return torch.stack([x + 0.1 * v, v + 0.1 * u], dim=-1)


def without(*columns):
    """Records that lack these states throughout."""
    states = moved().states.clone()
    states[:, columns] = NAN
    return Records(moved(states=states), POINT)


def three(**changed):
    good = {"times": torch.arange(3).double(), "states": column(0, 1, 2), "name": "r"}
    return Record(**{**good, "actions": column(0, 0, 0), **changed})


def steps(records, step):
    Records(records, POINT).trajectories(step)


def smoothed(physics=body, records=None, **options):
    smooth(Records(moved(), POINT) if records is None else records, physics, **options)


def identified(records=None, **options):
    identify(Records(moved(), POINT) if records is None else records, body, **options)


def sensed(**options):
    identified(sensors=Sensors(["x"], **options))


TEXT = np.array([["a"], ["b"], ["c"]])
UNEVEN = torch.tensor([0, 1, 3, 4, 7, 8.0]).double()
SHAKEN = (0.1 * torch.arange(20) + 0.02 * (torch.arange(20) % 2)).double()
SLOW = ODEPhysics(lambda x, u: x, step=0.2, state_dim=2)
FRAGILE = FunctionPhysics(lambda X: torch.where(X[:, :2] > 0.9, NAN, X[:, :2]))
IN_STEPS = partial(Records(moved(), StateSpec(["x", "v"], ["u"], step=0.2)).trajectories, 0.4)

GAIN = Sensors(["x"], gain={"x": Unknown(1.0, factor=2.0)})

SLOWER = r".* multiple of the sampling step, 0\.2, got 0\.1; take 0\.2"
UNEVEN_STEPS = r".* a tenth of its step 0\.1"

REFUSED = [
    # Records
    (lambda: three(times=torch.tensor([0, 2, 1.0]).double()), "'r', row 2: .*found 1 after 2"),
    (lambda: three(times=torch.tensor([0, NAN, 1.0]).double()), r"times of record 'r' .*\(row 1\)"),
    (lambda: three(times=column(0, 1, 2)), r"times of shape N, got \(3, 1\)"),
    (lambda: three(states=torch.arange(3.0).double()), r"N x state_dim, got \(3,\); .*reshape"),
    (lambda: three(states=column(0, math.inf, 0)), r"states of record 'r' .*\(row 1\)"),
    (lambda: three(actions=column(0, 0, NAN)), r"actions of record 'r' .*\(row 2\)"),
    (lambda: three(actions=column(0, 0)), "3 of times, 3 of states, 2 of actions"),
    (lambda: three(segments=[]), "3 of actions, 0 of segments"),
    (lambda: three(segments=[1, 1]), "3 of actions, 2 of segments"),
    (lambda: three(segments=[1, 2, 1]), "two rows or more of a segment, .* found 3 in all"),
    (lambda: moved(3, states=TEXT), TypeError, "contain numbers only"),
    (lambda: Records([], POINT), "one record or more"),
    (lambda: Records([TEXT], POINT), TypeError, r"as a Record\(times"),
    (lambda: Records(three(), POINT), "expected 2 columns of states, x"),
    (lambda: plot_record(Records(moved(), POINT), POINT), TypeError, "found Records"),
    (lambda: plot_record(moved(), "x"), TypeError, "spec must be a StateSpec"),
    # Control steps
    (lambda: steps([moved()], 0.25), r"multiple of .* 0\.1, got 0\.25; take 0\.2\."),
    (lambda: steps([moved()], 0.04), r"got 0\.04; take 0\.1\."),
    (lambda: steps([moved(), moved(step=0.2, name="slow")], None), f"'slow': {SLOWER}"),
    (lambda: steps([moved(times=SHAKEN, name="rough")], 0.1), f"'rough': {UNEVEN_STEPS}"),
    (lambda: steps([moved(6, times=UNEVEN)], 1), "few gaps, .* from 1 to 3.*numpy.interp"),
    (lambda: steps([moved()], -0.1), "step must be finite and above 0; found -0.1"),
    (lambda: steps([moved(3)], 0.4), "as long as a control step, 0.4, found none of 1"),
    (IN_STEPS, r"step of the spec, 0\.2, got 0\.4; leave `step` out"),
    (lambda: Records(moved(), POINT).windows(20), "stretches of 20 steps .* stretch has 19"),
    (lambda: Records(moved(), POINT).windows(0), "length must be at least 1"),
    (lambda: Records(moved(), POINT).windows(2, stride=0), "stride must be"),
    (lambda: without(1).trajectories(), "found none of 19. 'v' was never"),
    (lambda: without(1).windows(3), r"smooth\(.*draw\(\)\.windows"),
    # Smoothing
    (lambda: smoothed(start={"y": (0.0, 1.0)}), "there is no 'y' among the states"),
    (lambda: smoothed(start={"x": (0.0, 0.0)}), "mean and standard deviation of 'x'"),
    (lambda: smoothed(start=[0.0, 1.0]), TypeError, "start must be a dictionary"),
    (lambda: smoothed(noise=[0.1]), "noise of shape 2"),
    (lambda: smoothed(process_noise=[0.1, 0.0]), "process_noise as .* above 0"),
    (lambda: smoothed(max_rounds=0), "max_rounds must be at least 1"),
    (lambda: smoothed(num_starts=0), "num_starts must be at least 1"),
    (lambda: smoothed(lambda X: X[:, :1]), "next values of the 2 states .* got 1 columns"),
    (lambda: smoothed([body, body]), "Expected one physics to follow"),
    (lambda: smoothed(SLOW), r"makes steps of 0.2, but the control step .* is 0.1"),
    (lambda: smoothed(FRAGILE), PhysicsError, "fails at .* where smoothing begins"),
    (lambda: smoothed(lambda X: 1e200 * X[:, :2]), RuntimeError, "diverged from each of 1 starts"),
    (lambda: smoothed(records=without(1)), "'v' was never measured; give mean"),
    (lambda: smoothed(records=without(0, 1)), "found none of x, v"),
    (lambda: smoothed(records=moved()), TypeError, "records as Records"),
    (lambda: smoothed(records=Records(moved(), READ_LAG)), "an earlier value of the state"),
    # Sensors
    (lambda: identified(sensors="x"), TypeError, "sensors must be .*Sensors"),
    (lambda: identified(sensors=Sensors(["w"])), "Expected sensors of x, v, states that move"),
    (lambda: sensed(noise={"x": 0.1}), "an argument of `smooth`"),
    (lambda: sensed(function=lambda states: states), "without a function"),
    (lambda: sensed(gain={"x": 2.0}), TypeError, "unknowns must map names to Unknown"),
    (lambda: sensed(gain={"y": Unknown(1.0, factor=2.0)}), "Unknown output of gain 'y'"),
    (lambda: GAIN.measure(POINT, torch.zeros(1, 2)), "unknown gain, offset or delay is for `smo"),
    # Identification, and the check before it
    (lambda: identified(moved()), TypeError, r"Records\(\[record"),
    (lambda: identified(held_out=0.7), "at most 0.5"),
    (lambda: identified(Records(moved(6), POINT)), "8 control steps or more"),
    (lambda: identified(seed=-1), "seed"),
    (lambda: identified(without(1)), "'v' was never measured"),
    (lambda: identified(Records(moved(), LAGGED)), "states that all move"),
    (lambda: check_log(Records(moved(), POINT), body), "found none, to check"),
]


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case[-1][:30])
def test_what_is_refused(case):
    call, *kinds, words = case
    with pytest.raises((*kinds, ValueError)[0], match=words):
        call()


def test_a_search_that_does_not_settle():
    with pytest.warns(SmoothingWarning, match="did not settle in 2 rounds. Raise num_starts"):
        unsettled = smooth(Records(moved(), POINT), body, max_rounds=2)
    assert not unsettled.is_settled
    with pytest.raises(TypeError, match="seed must be a whole number"):
        unsettled.draw(1.5)
    with pytest.raises(ValueError, match="found no unknown parameters"):
        unsettled.variation  # noqa: B018


HEAD = "time,q,dq,tau\n"
FILES = [  # texts, options and words
    ("time,q,dq\n0,1,2\n", {}, "log.csv.*line 1: expected a column 'tau', found 'time', 'q', 'dq'"),
    (HEAD + "0,1,2,3\n\n1,2,x,3\n", {}, r".*line 4, column 3 \('dq'\): .*found 'x'"),
    (HEAD + "0,1,2,3\n1,2,3,\n", {}, r".*line 3, column 4 \('tau'\): .* number, found ''"),
    (HEAD + "0,1,2,3\n2,2,3,4\n1,2,3,4\n", {}, "log.csv', row 2: .*found 1 after 2"),
    (HEAD, {"states": {"y": "q"}}, "Unknown states 'y'; use 'x' or 'v'"),
    (HEAD, {"actions": ["u"]}, r"actions must be a dictionary .*found \['u'\]"),
    (HEAD + "0,1,2,3\n1,4,5,6\n", {"time": 0.0}, "time must be finite and above 0"),
]


@pytest.mark.parametrize(("text", "options", "words"), FILES)
def test_what_is_no_file_of_a_record(tmp_path, text, options, words):
    names = {"states": {"x": "q", "v": "dq"}, "actions": {"u": "tau"}}
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises((ValueError, TypeError), match=words):
        Records.read_csv(tmp_path / "log.csv", POINT, **{**names, **options})
