"""What is no record, no file, no step and no physics of a machine, and what errors say of it."""

import math
from functools import partial

import numpy as np
import pytest
import torch

from gpadjust.physics import FunctionPhysics, ODEPhysics, PhysicsError
from gpadjust.records import Record, Records, SmoothingWarning, identify, smooth
from gpadjust.records.plots import plot_record
from gpadjust.states import StateSpec

POINT = StateSpec(["x", "v"], ["u"])
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


def refused(cases):
    for call, error, words in cases:
        with pytest.raises(error, match=words):
            call()


def test_what_is_no_record():
    three = torch.arange(3).double()
    good = {"times": three, "states": column(0, 1, 2), "actions": column(0, 0, 0), "name": "r"}
    for changed, words in (
        ({"times": torch.tensor([0, 2, 1.0]).double()}, "'r', row 2: .*found 1 after 2"),
        (
            {"times": torch.tensor([0, NAN, 1]).double()},
            r"times of record 'r' to be finite, .*\(row 1\)",
        ),
        ({"times": three.unsqueeze(-1)}, r"times of shape N, got \(3, 1\)"),
        ({"states": three}, r"N x state_dim, got \(3,\); .*reshape\(-1, 1\)"),
        ({"states": column(0, math.inf, 0)}, r"states of record 'r' .*\(row 1\)"),
        ({"actions": column(0, 0, NAN)}, r"actions of record 'r' .*\(row 2\)"),
        ({"actions": column(0, 0)}, "3 of times, 3 of states, 2 of actions"),
        ({"segments": []}, "3 of actions, 0 of segments"),
        ({"segments": [1, 1]}, "3 of actions, 2 of segments"),
        ({"segments": [1, 2, 1]}, "two rows or more of a segment, .* found 3 in all"),
    ):
        refused([(partial(Record, **{**good, **changed}), ValueError, words)])
    text = np.array([["a"], ["b"], ["c"]])
    refused(
        [
            (lambda: moved(3, states=text), TypeError, "contain numbers only"),
            (lambda: Records([], POINT), ValueError, "one record or more"),
            (lambda: Records([text], POINT), TypeError, r"as a Record\(times"),
            (lambda: Records(Record(**good), POINT), ValueError, "expected 2 columns of states, x"),
            (lambda: plot_record(Records(moved(), POINT), POINT), TypeError, "found Records"),
            (lambda: plot_record(Record(**good), POINT), ValueError, "2 columns of states"),
            (lambda: plot_record(moved(), "x"), TypeError, "spec must be a StateSpec"),
        ]
    )


def test_steps_that_records_do_not_have():
    uneven = moved(6, times=torch.tensor([0, 1, 3, 4, 7, 8.0]).double())
    shaken = 0.1 * torch.arange(20) + 0.02 * (torch.arange(20) % 2)
    slow = [moved(), moved(step=0.2, name="slow")]
    for records, step, words in (
        ([moved()], 0.25, r"multiple of .* 0\.1, got 0\.25; take 0\.2\."),
        ([moved()], 0.04, r"got 0\.04; take 0\.1\."),
        (slow, None, r"'slow': .* multiple of the sampling step, 0\.2, got 0\.1; take 0\.2"),
        (
            [moved(times=shaken.double(), name="rough")],
            0.1,
            r"'rough': .* a tenth of its step 0\.1",
        ),
        ([uneven], 1, "few gaps, found times between rows from 1 to 3.*numpy.interp"),
        ([moved()], -0.1, "step must be finite and above 0; found -0.1"),
        ([moved(3)], 0.4, "as long as a control step, 0.4, found none of 1"),
    ):
        of = Records(records, POINT)
        for call in (of.trajectories, partial(of.windows, 1), partial(smooth, of, body)):
            refused([(partial(call, step), ValueError, words)])
    records = Records(moved(), POINT)
    spec = StateSpec(["x", "v"], ["u"], step=0.2)
    said = Records(moved(), spec).trajectories
    refused(
        [
            (partial(said, 0.4), ValueError, r"step of the spec, 0\.2, got 0\.4; leave `step` out"),
            (partial(records.windows, 20), ValueError, "stretches of 20 steps .* stretch has 19"),
            (partial(records.windows, 0), ValueError, "length must be at least 1"),
            (partial(records.windows, 2, stride=0), ValueError, "stride must be"),
            (without(1).trajectories, ValueError, "found none of 19. 'v' was never"),
            (partial(without(1).windows, 3), ValueError, r"smooth\(.*draw\(\)\.windows"),
        ]
    )


def test_what_is_no_file_of_a_record(tmp_path):
    def read(text, **options):
        (tmp_path / "log.csv").write_text(text)
        names = {"states": {"x": "q", "v": "dq"}, "actions": {"u": "tau"}}
        return partial(Records.read_csv, tmp_path / "log.csv", POINT, **{**names, **options})

    head = "time,q,dq,tau\n"
    for text, words in (
        ("\n\n", ".*expected a line of names and then rows, found an empty file"),
        ("time,q,dq\n0,1,2\n", ".*line 1: expected a column 'tau', found 'time', 'q', 'dq'"),
        (head + "0,1,2,3\n\n1,2,x,3\n", r".*line 4, column 3 \('dq'\): .*found 'x'"),
        (head + "0,1,inf,3\n1,2,3,4\n", r".*line 2, column 3 \('dq'\): .*found 'inf'"),
        (head + "0,1,2,3\n1,2,3,\n", r".*line 3, column 4 \('tau'\): .* number, found ''"),
        (head + "0,1,2,3\n2,2,3,4\n1,2,3,4\n", "', row 2: .*found 1 after 2"),
        (head + "0,1,2,3\n", "': expected two rows or more"),
    ):
        refused([(read(text), ValueError, f"log.csv{words}")])
    for options, error, words in (
        ({"states": {"y": "q"}}, ValueError, "Unknown states 'y'; use 'x' or 'v'"),
        ({"actions": ["u"]}, TypeError, r"actions must be a dictionary .*found \['u'\]"),
        ({"time": 0.0}, ValueError, "time must be finite and above 0"),
    ):
        refused([(read(head + "0,1,2,3\n1,4,5,6\n", **options), error, words)])


def test_what_cannot_be_smoothed():
    records, slow = Records(moved(), POINT), ODEPhysics(lambda x, u: x, step=0.2, state_dim=2)
    fragile = FunctionPhysics(lambda X: torch.where(X[:, :2] > 0.9, NAN, X[:, :2]))
    wild = FunctionPhysics(lambda X: 1e200 * X[:, :2])
    lagged = StateSpec(["x", "v"], ["u"], previous={"v": "x"}, physics_reads=["x", "v", "u"])
    for physics, options, error, words in (
        (body, {"start": {"y": (0.0, 1.0)}}, ValueError, "there is no 'y' among the states"),
        (body, {"start": {"x": (0.0, 0.0)}}, ValueError, "mean and standard deviation of 'x'"),
        (body, {"start": [0.0, 1.0]}, TypeError, "start must be a dictionary"),
        (body, {"noise": [0.1]}, ValueError, "noise of shape 2"),
        (body, {"process_noise": [0.1, 0.0]}, ValueError, "process_noise as .* above 0"),
        (body, {"max_rounds": 0}, ValueError, "max_rounds must be at least 1"),
        (body, {"num_starts": 0}, ValueError, "num_starts must be at least 1"),
        (lambda X: X[:, :1], {}, ValueError, "next values of the 2 states .* got 1 columns"),
        ([body, body], {}, ValueError, "Expected one physics to follow"),
        (slow, {}, ValueError, r"makes steps of 0.2, but the control step .* is 0.1"),
        (fragile, {}, PhysicsError, r"fails at .* where smoothing begins"),
        (wild, {}, RuntimeError, "diverged from each of 1 starts"),
        (body, {"records": without(1)}, ValueError, "'v' was never measured; give mean"),
        (body, {"records": without(0, 1)}, ValueError, "found none of x, v"),
        (body, {"records": moved()}, TypeError, "records as Records"),
        (body, {"records": Records(moved(), lagged)}, ValueError, "an earlier value of the state"),
    ):
        given = {"records": records, "physics": physics, **options}
        refused([(partial(smooth, **given), error, words)])
    with pytest.warns(SmoothingWarning, match="did not settle in 2 rounds. Raise num_starts"):
        smoothed = smooth(records, body, max_rounds=2)
    assert not smoothed.is_settled
    with pytest.raises(TypeError, match="seed must be a whole number"):
        smoothed.draw(1.5)


def test_what_cannot_be_identified():
    records = Records(moved(), POINT)
    lagged = StateSpec(["x", "v"], ["u"], previous={"v": "x"})
    for options, error, words in (
        ({"records": moved()}, TypeError, r"Records\(\[record"),
        ({"held_out": 0.7}, ValueError, "at most 0.5"),
        ({"records": Records(moved(6), POINT)}, ValueError, "8 control steps or more"),
        ({"seed": -1}, ValueError, "seed"),
        ({"records": without(1)}, ValueError, "'v' was never measured"),
        ({"records": Records(moved(), lagged)}, ValueError, "states that all move"),
    ):
        given = {"records": records, "physics": body, **options}
        refused([(partial(identify, **given), error, words)])
