"""Arrays and frames that NumPy would turn into other numbers are refused with the way out."""

from datetime import date, datetime, time, timedelta
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust import CKA, VariationalCKA
from gpadjust.models.training_data import to_tensor
from gpadjust.physics import BlackBoxPhysics, PhysicsError
from gpadjust.records import Record
from gpadjust.sklearn import CKARegressor
from tests.systems import refused

N = 6
ONE_TO_SIX = np.arange(1.0, N + 1)
SECOND = np.timedelta64(1, "s")
DATES = np.datetime64("2020-01-01") + np.arange(N) * SECOND

TEXT = {
    "text": ONE_TO_SIX.astype(str),
    "bytes": ONE_TO_SIX.astype("S"),
    "text as objects": ONE_TO_SIX.astype(str).astype(object),
    "one text among numbers": np.array([*ONE_TO_SIX[1:], "1.5"], dtype=object),
    "a column of text": pd.Series(ONE_TO_SIX.astype(str)),
    "text of each row": pd.Series(["a", "b", "c", "d", "e", "f"]),
}
COMPLEX = {
    "complex": ONE_TO_SIX + 1j,
    "complex without imaginary part": ONE_TO_SIX.astype(complex),
    "one complex among numbers": np.array([*ONE_TO_SIX[1:], 1j], dtype=object),
    "a column": pd.Series(ONE_TO_SIX + 1j),
    "tensor": torch.tensor(ONE_TO_SIX + 1j),
}
TIMES = {
    "dates": DATES,
    "durations": DATES - DATES[0],
    "index": pd.date_range("2020", periods=N, freq="s"),
    "column": pd.Series(DATES),
    "time zone": pd.Series(pd.date_range("2020", periods=N, freq="s", tz="Europe/London")),
    "column of durations": pd.Series(pd.to_timedelta(range(N), unit="s")),
    "datetime": np.array([datetime(2020, 1, 1, 0, 0, i) for i in range(N)], dtype=object),
    "date": np.array([date(2020, 1, i + 1) for i in range(N)], dtype=object),
    "time": np.array([time(0, 0, i) for i in range(N)], dtype=object),
    "timedelta": np.array([timedelta(seconds=i) for i in range(N)], dtype=object),
}
REFUSED = [
    *[pytest.param(values, "text.*astype", id=f"text: {name}") for name, values in TEXT.items()],
    *[pytest.param(v, "complex numbers.*parts", id=f"complex: {n}") for n, v in COMPLEX.items()],
    *[pytest.param(v, "dates or times.*to seconds", id=f"times: {n}") for n, v in TIMES.items()],
]


def column(values):
    """Values, an array or a series, as a single column."""
    if isinstance(values, pd.Series | pd.Index):
        return values.to_frame()
    return values.reshape(-1, 1)


def physics(X):
    return 2 + X.sum(-1)


@pytest.mark.parametrize(("values", "message"), REFUSED)
class TestRefused:
    def test_inputs(self, values, message):
        with pytest.raises(TypeError, match=rf"train_X to hold numbers.*{message}"):
            CKA(column(values), column(ONE_TO_SIX), physics=physics)

    def test_targets(self, values, message):
        with pytest.raises(TypeError, match=rf"train_Y to hold numbers.*{message}"):
            CKA(column(ONE_TO_SIX), column(values), physics=physics)

    def test_questions_and_observations(self, values, message):
        model = CKA(column(ONE_TO_SIX), column(ONE_TO_SIX), physics=physics)
        refused(TypeError, rf"X to hold numbers.*{message}", model.predict, column(values))
        with pytest.raises(TypeError, match=rf"Y to hold numbers.*{message}"):
            model.condition_on_observations(column(ONE_TO_SIX), column(values))

    def test_records(self, values, message):
        numbers = column(ONE_TO_SIX)
        if "times" not in message or type(np.asarray(values).flat[0]) in (date, time):
            with pytest.raises(TypeError, match=rf"times to hold numbers.*{message}"):
                Record(values, numbers, numbers)
        with pytest.raises(TypeError, match=rf"states to hold numbers.*{message}"):
            Record(ONE_TO_SIX, column(values), numbers)


@pytest.mark.parametrize("name", [n for n in TIMES if n not in ("date", "time")])
def test_times_of_a_record_are_seconds_since_the_first(name):
    record = Record(TIMES[name], column(ONE_TO_SIX), column(ONE_TO_SIX))
    assert record.times.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_velocities_are_in_seconds():
    """A point that moves by 3 m/s, every 250 ms, by the clock of a pandas frame."""
    index = pd.date_range("2020-03-29 00:59:59", periods=9, freq="250ms", tz="Europe/London")
    frame = pd.DataFrame({"x": 0.75 * np.arange(9.0), "u": 0.0}, index=index)
    record = Record(frame.index, frame[["x"]], frame[["u"]])  # the clocks change in it
    assert record.sampling_step == 0.25
    speed = record.states.diff(dim=0) / record.times.diff().unsqueeze(-1)
    assert speed.flatten().tolist() == [3.0] * 8


def test_scikit_learn_is_asked_before_it_makes_numbers_of_them():
    regressor = CKARegressor(lambda X: X[:, 0], fit_method="map")
    numbers, dates = column(ONE_TO_SIX), DATES.reshape(-1, 1)
    masked = np.ma.masked_array(numbers, mask=numbers == 3)
    for X, y, message in [
        (dates, ONE_TO_SIX, "X to hold numbers.*dates or times"),
        (numbers, DATES - DATES[0], "y to hold numbers.*dates or times"),
        (masked, ONE_TO_SIX, "X without masked"),
        (numbers, masked[:, 0], "y without masked"),
    ]:
        refused((TypeError, ValueError), message, regressor.fit, X, y)
    with pytest.raises(ValueError, match="train_Yvar without masked"):
        regressor.fit(numbers, ONE_TO_SIX, train_Yvar=masked[:, 0])
    with pytest.raises(TypeError, match=r"X to hold numbers.*dates or times"):
        regressor.fit(numbers, ONE_TO_SIX).predict(dates)


def test_a_physics_that_returns_masked_values():
    masked = np.ma.masked_array(ONE_TO_SIX, mask=ONE_TO_SIX == 3)
    with pytest.raises(PhysicsError, match="masked values"):
        CKA(column(ONE_TO_SIX), column(ONE_TO_SIX), physics=BlackBoxPhysics(lambda X: masked))


def test_a_frame_with_a_column_of_times():
    frame = pd.DataFrame({"t": DATES, "x": ONE_TO_SIX})
    refused(TypeError, r"train_X.*dates or times", CKA, frame, column(ONE_TO_SIX), physics=physics)


class TestMasked:
    values = np.ma.masked_array(column(ONE_TO_SIX), mask=column(ONE_TO_SIX) == 3)

    def test_inputs_and_targets(self):
        with pytest.raises(ValueError, match="train_X without masked"):
            CKA(self.values, column(ONE_TO_SIX), physics=physics)
        with pytest.raises(ValueError, match=r"train_Y.filled\(np.nan\)"):
            CKA(column(ONE_TO_SIX), self.values, physics=physics)
        with pytest.raises(ValueError, match="times without masked values"):
            Record(self.values[:, 0], column(ONE_TO_SIX), column(ONE_TO_SIX))

    def test_the_way_out(self):
        Y = np.ma.hstack([self.values, column(ONE_TO_SIX)])
        model = CKA(column(ONE_TO_SIX), Y.filled(np.nan), physics=lambda X: X + torch.ones(2))
        assert model.train_targets.isnan().tolist()[0] == [False, False, True, False, False, False]

    def test_a_mask_of_nothing(self):
        array = np.ma.masked_array(ONE_TO_SIX, mask=False)
        assert to_tensor(array, "X").tolist() == ONE_TO_SIX.tolist()


@pytest.mark.parametrize(
    "values",
    [
        np.arange(1, N + 1),
        np.arange(1, N + 1, dtype=np.uint8),
        ONE_TO_SIX.astype(np.float32),
        ONE_TO_SIX.astype(object),
        np.array([Fraction(i, 1) for i in range(1, N + 1)], dtype=object),
        np.array([Decimal(i) for i in range(1, N + 1)], dtype=object),
        pd.Series(ONE_TO_SIX, dtype="Float64"),
        pd.Series(range(1, N + 1)),
        pd.RangeIndex(1, N + 1),
    ],
    ids=lambda values: f"{type(values).__name__}-{values.dtype}",
)
def test_real_numbers_are_taken(values):
    assert to_tensor(values, "X").tolist() == ONE_TO_SIX.tolist()


@pytest.mark.parametrize("make", [torch.as_tensor, np.asarray, pd.Series])
def test_inputs_of_one_dimension(make, build, kind):
    X, Y = make(ONE_TO_SIX), torch.as_tensor(column(ONE_TO_SIX))
    options = {"low_X": Y, "low_Y": Y, "physics": None} if kind == "AR1" else {}
    if kind not in ("ZeroMeanGP", "AR1"):
        options["physics"] = physics
    refused(ValueError, r"train_X.reshape\(-1, 1\)", build, kind, X, Y, **options)


def test_inputs_of_one_dimension_of_a_sparse_model():
    X = torch.as_tensor(ONE_TO_SIX)
    with pytest.raises(ValueError, match=r"train_X.*2 dimensions"):
        VariationalCKA(X, X.unsqueeze(-1), physics=physics)
