"""Records of machines: transitions and windows."""

import math
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust.dynamics import PhysicsDynamics, StateSpec, Trajectories
from gpadjust.records import Record, Records
from tests.systems import uniform

SPEC = StateSpec(["x"], ["u"])
POINT = StateSpec(["x", "v"], ["u"])


def column(*values):
    return torch.tensor(values, dtype=torch.float64).reshape(-1, 1)


def steps_of_episodes(data):
    """How many steps each episode has, one after the other."""
    return data.episode.unique_consecutive(return_counts=True)[1].tolist()


def counted(num_rows, first=0.0, at=None, **options):
    """A record whose state is the number of its row from ``first``, and whose action its square."""
    rows = first + torch.arange(num_rows, dtype=torch.float64).unsqueeze(-1)
    return Record(0.01 * rows[:, 0] if at is None else at, rows, rows.square(), **options)


def test_a_control_step_is_every_kth_row_with_the_mean_action():
    data = Records([counted(8)], SPEC).trajectories(0.03)
    assert data.states.flatten().tolist() == [0, 3]
    assert data.next_states.flatten().tolist() == [3, 6]
    assert data.actions.flatten().tolist() == pytest.approx([5 / 3, (9 + 16 + 25) / 3])
    assert all(tensor.dtype == torch.float64 for tensor in data)
    assert isinstance(data, Trajectories)
    every = Records([counted(8)], SPEC).trajectories()
    assert every.states.flatten().tolist() == [*range(7)]


def test_no_step_crosses_segments_gaps_or_records():
    """The clock may start again in a segment."""
    segments = ["a"] * 12 + ["b"] * 13 + ["a"] * 6
    clock = 0.01 * torch.cat([torch.arange(n) for n in (12, 13, 6)]).double()
    rows = torch.cat([torch.arange(11), torch.arange(13, 30)]).double()  # 11 and 12 are missing
    records = [
        counted(31, segments=segments, at=clock),
        Record(0.01 * rows, rows.unsqueeze(-1), rows.unsqueeze(-1)),
        counted(14, first=70.0, name="late"),
    ]
    for k in (1, 2, 5):
        data = Records(records, SPEC).trajectories(0.01 * k)
        lengths = [(n - 1) // k for n in (12, 13, 6, 11, 17, 14)]
        assert (data.next_states - data.states).unique().tolist() == [k]
        assert steps_of_episodes(data) == lengths


def test_rounded_times_are_even():
    """Of 120 Hz in ms; the time from a row to the next is 8 or 9 ms."""
    times = (torch.arange(500, dtype=torch.float64) / 120).mul(1000).round() / 1000
    records = Records([counted(500, at=times)], SPEC)
    assert len(records.trajectories(1 / 24).states) == 99
    assert records.records[0].sampling_step == pytest.approx(1 / 120, rel=1e-3)


def test_states_that_were_not_measured():
    nan = math.nan
    rows = [[0, 0], [1, 1], [2, nan], [3, 3], [nan, nan], [5, 5], [6, 6], [nan, nan]]
    record = Record(torch.arange(8).double(), torch.tensor(rows).double(), column(*[0] * 8))
    with pytest.warns(UserWarning, match=r"Left out: 4 of 7 steps, 2 of which start at"):
        data = Records(record, POINT).trajectories()
    assert data.states[:, 0].tolist() == [0, 1, 5]
    assert data.next_states[1].tolist() == pytest.approx([2, nan], nan_ok=True)
    assert steps_of_episodes(data) == [2, 1]


def test_stretches_that_are_too_short_are_left_out():
    records = Records([counted(9, segments=[math.nan, 2, 2, 2, 2, 2, 3, 3, 3])], SPEC)
    with pytest.warns(UserWarning, match="1 of 3 stretches"):
        assert records.trajectories().states.flatten().tolist() == [1, 2, 3, 4, 6, 7]
    with pytest.warns(UserWarning, match="2 of 3 stretches"):
        assert records.trajectories(0.04).states.flatten().tolist() == [1]


@pytest.mark.parametrize(("names", "k"), [(("x_1", "x_2", "u_1"), 2), (("u_1", "x_2", "x_1"), 1)])
def test_previous_states_are_those_of_the_steps_before(names, k):
    lags = {"x_1": "x", "x_2": "x_1", "u_1": "u"}
    spec = StateSpec([*names, "x"], ["u"], previous={name: lags[name] for name in names})
    record = counted(24, segments=["a"] * 13 + ["b"] * 11)
    never = torch.full((24, 3), math.nan, dtype=torch.float64)
    states = torch.cat([never, record.states], -1)
    records = Records(Record(record.times, states, record.actions, record.segments), spec)
    with pytest.warns(UserWarning, match="4 of which start at a state not measured in full"):
        data = records.trajectories(0.01 * k)
    starts = [*range(2 * k, 13 - k, k), *range(13 + 2 * k, 24 - k, k)]
    assert data.states[:, 3].tolist() == starts
    pair = data.states, data.next_states
    now, after = ({n: t[:, i] for i, n in enumerate(spec.states)} for t in pair)
    assert (now["x"] - now["x_1"]).unique().tolist() == [k]
    assert (now["x"] - now["x_2"]).unique().tolist() == [2 * k]
    before = [sum((row - j) ** 2 for j in range(1, k + 1)) / k for row in starts]
    assert now["u_1"].tolist() == pytest.approx(before)
    assert torch.equal(after["x_2"], now["x_1"])
    assert torch.equal(after["u_1"], data.actions[:, 0])
    PhysicsDynamics(spec, lambda X: X[:, :1] + k).update(*data)  # as the spec says
    assert records.windows(3, 0.01 * k).initial_states[0, 3] == 2 * k
    states[0, :3] = torch.tensor([-1.0, -2.0, -3.0])  # of the first row it is known
    records = Records(Record(record.times, states, record.actions, record.segments), spec)
    left = "2 of which start" if k == 1 else "4 of which start"  # of a row before, not of a step
    with pytest.warns(UserWarning, match=left):
        data = records.trajectories(0.01 * k)
    assert data.states[0, 3] == (0 if k == 1 else 2 * k)


def test_records_may_differ_in_their_sampling_steps_and_the_step_of_the_spec_is_the_default():
    slow = counted(5, first=20, at=0.02 * torch.arange(5).double())
    records = [counted(9), slow]
    assert Records(records, SPEC).trajectories(0.04).states.flatten().tolist() == [0, 4, 20, 22]
    data = Records(records, StateSpec(["x"], ["u"], step=0.02)).trajectories()
    assert data.states.flatten().tolist() == [0, 2, 4, 6, 20, 21, 22, 23]


def test_windows_have_the_steps_of_transitions():
    records = Records([counted(31, segments=[0] * 14 + [1] * 17), counted(23, first=50.0)], SPEC)
    windows = records.windows(3, 0.02)
    assert windows.initial_states.flatten().tolist() == [0, 6, 14, 20, 50, 56, 62]
    steps = torch.arange(1, 4) * 2
    torch.testing.assert_close(windows.measured[..., 0], windows.initial_states + steps)
    data = records.trajectories(0.02)
    for i, start in enumerate(windows.initial_states):
        row = int((data.states == start).nonzero()[0, 0])
        assert torch.equal(windows.actions[i], data.actions[row : row + 3])
    sliding = records.windows(3, 0.02, stride=1)
    assert len(sliding.initial_states) == 4 + 6 + 9


def test_a_few_transitions_spread_over_all():
    data = Records([counted(41), counted(62, first=100.0)], SPEC).trajectories()
    before = torch.get_rng_state()
    few = data.spread(10, seed=3)
    assert torch.equal(before, torch.get_rng_state())
    rows = [data.states.flatten().tolist().index(x) for x in few.states.flatten().tolist()]
    assert [row * 10 // 101 for row in rows] == [*range(10)]
    assert torch.equal(few.next_states, few.states + 1)
    assert torch.equal(few.actions, few.states.square())
    assert torch.equal(data.spread(10, seed=3).states, few.states)
    assert not torch.equal(data.spread(10, seed=4).states, few.states)
    assert torch.equal(data.spread(101).states, data.states)
    with pytest.raises(ValueError, match=r"number <= 101, .* got 102"):
        data.spread(102)


def test_dates_and_durations_are_seconds_since_the_first():
    days = pd.date_range("2026-10-25 01:30", periods=4, freq="30min", tz="Europe/Berlin")
    universal, states = days.tz_convert("UTC").tz_localize(None), column(0, 1, 2, 3)
    durations = days - days[0]
    for times in (days, universal, durations, durations.to_numpy(), days.to_series()):
        assert Record(times, states, states).times.tolist() == [0, 1800, 3600, 5400]


def test_a_record_takes_tensors_arrays_and_frames():
    columns = {"t": [0.0, 1, 2], "x": [1, 2, 3], "u": [4, 5, 6], "part": ["a", "a", "b"]}
    frame = pd.DataFrame(columns)
    frames = frame["t"], frame[["x"]], frame[["u"]]
    arrays = [part.to_numpy(copy=True) for part in frames]
    tensors = [torch.tensor(part).double() for part in arrays]
    for parts in (frames, arrays, tensors):
        record = Record(*parts, segments=frame["part"])
        assert record.times.tolist() == [0, 1, 2]
        assert record.states.tolist() == [[1], [2], [3]]
        assert record.actions.dtype == torch.float64
        assert record.segments == ("a", "a", "b")
        assert [(rows.start, rows.stop) for rows in record.stretches()] == [(0, 2), (2, 3)]
        if parts is not frames:
            parts[1][0] = 9
            assert record.states[0] == 1, "it has data of its own"


NAMES = {"states": {"x": "q", "v": "dq"}, "actions": {"u": "tau"}}


def test_csv_files_are_read_as_pandas_reads_them(tmp_path):
    expected = []
    for i in range(2):
        frame = pd.DataFrame(uniform(20, 3, seed=i).numpy(), columns=["q", "tau", "dq"])
        frame.insert(0, "time", 0.1 * np.arange(20))
        frame["spare"], frame["part"] = "text", ["one"] * 12 + ["two"] * 8
        frame.loc[3, "dq"] = math.nan
        file = tmp_path / f"{i}.csv"
        frame.to_csv(file, index=False)
        columns = frame["time"], frame[["q", "dq"]], frame[["tau"]], frame["part"]
        expected.append(Record(*columns, name=str(file)))
    files = [record.name for record in expected]
    records = Records.read_csv(files, POINT, **NAMES, segment="part")
    for record, other in zip(records, expected, strict=True):
        assert (record.name, record.segments) == (other.name, other.segments)
        for name in ("times", "states", "actions"):
            pair = getattr(record, name), getattr(other, name)
            torch.testing.assert_close(*pair, rtol=0, atol=0, equal_nan=True)


def test_csv_files_without_times_or_with_a_name_twice(tmp_path):
    file = tmp_path / "log.csv"
    for text, options, end in (
        ("q,dq,tau\n1,2,3\n4,5,6\n", {"time": 0.5}, 0.5),
        ("x,q,x,dq,tau,time\na,1,a,2,3,0\na,4,a,5,6,1\n", {}, 1),
    ):
        file.write_text(text)
        (record,) = Records.read_csv(file, POINT, **NAMES, **options)
        assert record.times.tolist() == [0, end]
        assert record.states.tolist() == [[1, 2], [4, 5]]
        assert record.actions.tolist() == [[3], [6]]


def test_columns_of_the_same_names_need_no_words_and_hidden_states_no_column(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("time,v,u,x\n0,1,2,\n1,4,5,nan\n")
    (record,) = Records.read_csv(str(file), POINT)
    assert record.states.tolist() == [[pytest.approx(math.nan, nan_ok=True), v] for v in (1, 4)]
    file.write_text("time,x,u\n0,1,2\n1,4,5\n")
    (record,) = Records.read_csv(file, POINT, states={"v": None})
    assert record.states[:, 0].tolist() == [1, 4]
    assert record.states[:, 1].isnan().all()
    for held in ("u", "x"):
        spec = StateSpec(["x", "last"], ["u"], previous={"last": held})
        (record,) = Records.read_csv(file, spec)
        assert record.states[:, 1].isnan().all()
        with pytest.raises(ValueError, match="expected a column 'before'"):
            Records.read_csv(file, spec, states={"last": "before"})


def test_windows_are_drawn_evenly_and_are_records_again():
    windows = Records(counted(40), SPEC).windows(3, 0.01)
    drawn = windows.spread(4, seed=1)
    assert drawn.states.shape == (4, 4, 1)
    numbers = (drawn.states[:, 0, 0] / 3).tolist()  # of 13, one of each of four parts
    ends = pairwise((0, 3, 6, 9, 13))
    assert all(low <= i < high for i, (low, high) in zip(numbers, ends, strict=True))
    assert torch.equal(windows.spread(4, seed=1).states, drawn.states)
    again = Records.of_windows(drawn, SPEC, 0.01).windows(3, 0.01)
    for part, other in zip(again, drawn, strict=True):
        assert torch.equal(part, other)
    with pytest.raises(ValueError, match=r"number <= 13, .* got 14"):
        windows.spread(14)
