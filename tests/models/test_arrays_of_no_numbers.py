"""Arrays and frames that NumPy would turn into other numbers are refused with the way out."""

from datetime import date, datetime, time, timedelta
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust import AR1, CKA, VariationalCKA
from gpadjust.models.training_data import to_tensor
from gpadjust.physics import BlackBoxPhysics, PhysicsError
from gpadjust.records import Record
from gpadjust.sklearn import CKARegressor
from tests.systems import refused

N = 6
ONE_TO_SIX = np.arange(1.0, N + 1)
NUMBERS = ONE_TO_SIX.reshape(-1, 1)
DATES = np.datetime64("2020-01-01") + np.arange(N) * np.timedelta64(1, "s")
MASKED = np.ma.masked_array(NUMBERS, mask=NUMBERS == 3)

TEXT = [
    ONE_TO_SIX.astype(str),
    ONE_TO_SIX.astype("S"),
    ONE_TO_SIX.astype(str).astype(object),
    np.array([*ONE_TO_SIX[1:], "1.5"], dtype=object),
    pd.Series(ONE_TO_SIX.astype(str)),
    pd.Series(["a", "b", "c", "d", "e", "f"]),
]
COMPLEX = [
    ONE_TO_SIX + 1j,
    ONE_TO_SIX.astype(complex),
    np.array([*ONE_TO_SIX[1:], 1j], dtype=object),
    pd.Series(ONE_TO_SIX + 1j),
    torch.tensor(ONE_TO_SIX + 1j),
]
TIMES = [
    DATES,
    DATES - DATES[0],
    pd.date_range("2020", periods=N, freq="s"),
    pd.Series(DATES),
    pd.Series(pd.date_range("2020", periods=N, freq="s", tz="Europe/London")),
    pd.Series(pd.to_timedelta(range(N), unit="s")),
    np.array([datetime(2020, 1, 1, 0, 0, i) for i in range(N)], dtype=object),
    np.array([timedelta(seconds=i) for i in range(N)], dtype=object),
]
DAYS = np.array([date(2020, 1, i + 1) for i in range(N)], dtype=object)
CLOCK = np.array([time(0, 0, i) for i in range(N)], dtype=object)
TEXTS, COMPLEXES = "text.*astype", "complex numbers.*parts"
DATED = "dates or times.*to seconds"


def column(values):
    """Values, an array or a series, as a single column."""
    is_pandas = isinstance(values, pd.Series | pd.Index)
    return values.to_frame() if is_pandas else values.reshape(-1, 1)


def physics(X):
    return 2 + X.sum(-1)


def cka(X=NUMBERS, Y=NUMBERS):
    return CKA(X, Y, physics=physics)


@pytest.mark.parametrize(
    ("arrays", "says"), [(TEXT, TEXTS), (COMPLEX, COMPLEXES), ([*TIMES, DAYS, CLOCK], DATED)]
)
def test_what_is_refused(arrays, says):
    for values in arrays:
        refused(TypeError, rf"Expected X to hold numbers.*{says}", to_tensor, column(values), "X")


@pytest.mark.parametrize(
    ("call", "name", "says"),
    [
        (lambda: cka(column(TEXT[0])), "train_X", TEXTS),
        (lambda: cka(column(TEXT[5])), "train_X", TEXTS),  # names of rows are no categories
        (lambda: cka(pd.DataFrame({"t": DATES, "x": ONE_TO_SIX})), "train_X", DATED),
        (lambda: cka(NUMBERS, column(COMPLEX[0])), "train_Y", COMPLEXES),
        (lambda: cka().predict(column(DATES)), "X", DATED),
        (lambda: cka().condition_on_observations(NUMBERS, column(TEXT[4])), "Y", TEXTS),
        (lambda: Record(COMPLEX[3], NUMBERS, NUMBERS), "times", COMPLEXES),
        (lambda: Record(COMPLEX[4], NUMBERS, NUMBERS), "times", COMPLEXES),
        (lambda: Record(DAYS, NUMBERS, NUMBERS), "times", DATED),
        (lambda: Record(CLOCK, NUMBERS, NUMBERS), "times", DATED),
        (lambda: Record(ONE_TO_SIX, column(DATES), NUMBERS), "states", DATED),
    ],
)
def test_where_it_is_refused(call, name, says):
    refused(TypeError, rf"{name} to hold numbers.*{says}", call)


@pytest.mark.parametrize("times", TIMES, ids=range(len(TIMES)))
def test_times_of_a_record_are_seconds_since_the_first(times):
    record = Record(times, NUMBERS, NUMBERS)
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
    dates, y = DATES.reshape(-1, 1), ONE_TO_SIX
    refused(TypeError, "X to hold numbers.*dates or times", regressor.fit, dates, y)
    refused(
        TypeError, "y to hold numbers.*dates or times", regressor.fit, NUMBERS, DATES - DATES[0]
    )
    refused(ValueError, "X without masked", regressor.fit, MASKED, y)
    refused(ValueError, "y without masked", regressor.fit, NUMBERS, MASKED[:, 0])
    known = {"train_Yvar": MASKED[:, 0]}
    refused(ValueError, "train_Yvar without masked", regressor.fit, NUMBERS, y, **known)
    predict = regressor.fit(NUMBERS, y).predict
    refused(TypeError, r"X to hold numbers.*dates or times", predict, dates)


def test_masked_values():
    refused(ValueError, "train_X without masked", cka, MASKED)
    refused(ValueError, r"train_Y.filled\(np.nan\)", cka, NUMBERS, MASKED)
    times = MASKED[:, 0]
    refused(ValueError, "times without masked values", Record, times, NUMBERS, NUMBERS)
    masked = BlackBoxPhysics(lambda X: times)
    refused(PhysicsError, "masked values", CKA, NUMBERS, NUMBERS, physics=masked)
    Y = np.ma.hstack([MASKED, NUMBERS]).filled(np.nan)  # the way out
    model = CKA(NUMBERS, Y, physics=lambda X: X + torch.ones(2))
    assert model.train_targets.isnan().tolist()[0] == [False, False, True, False, False, False]
    nothing = np.ma.masked_array(ONE_TO_SIX, mask=False)
    assert to_tensor(nothing, "X").tolist() == ONE_TO_SIX.tolist()


def test_real_numbers_are_taken():
    whole = range(1, N + 1)
    for values in (
        np.arange(1, N + 1),
        np.arange(1, N + 1, dtype=np.uint8),
        ONE_TO_SIX.astype(np.float32),
        ONE_TO_SIX.astype(object),
        np.array([Fraction(i, 1) for i in whole], dtype=object),
        np.array([Decimal(i) for i in whole], dtype=object),
        pd.Series(ONE_TO_SIX, dtype="Float64"),
        pd.Series(whole),
        pd.RangeIndex(1, N + 1),
    ):
        assert to_tensor(values, "X").tolist() == ONE_TO_SIX.tolist()


def test_inputs_of_one_dimension():
    X, Y = torch.as_tensor(ONE_TO_SIX), torch.as_tensor(NUMBERS)
    for values in (X, ONE_TO_SIX, pd.Series(ONE_TO_SIX)):
        refused(ValueError, r"train_X.reshape\(-1, 1\)", cka, values)
    refused(ValueError, r"train_X.reshape\(-1, 1\)", AR1, X, Y, low_X=Y, low_Y=Y)
    refused(ValueError, r"train_X.*2 dimensions", VariationalCKA, X, Y, physics=physics)
