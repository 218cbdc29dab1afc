"""Columns of a frame as inputs, targets and variances, which a model takes as columns."""

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust import CKA, PhysicsMeanGP, ZeroMeanGP, compare, fit
from gpadjust.physics import FormulaPhysics
from gpadjust.records import Record
from gpadjust.sklearn import CKARegressor

RANDOM = np.random.default_rng(0)
FRAME = pd.DataFrame({"a": RANDOM.uniform(size=9), "b": RANDOM.uniform(size=9)}, range(5, 14))
FRAME["y"], FRAME["v"] = np.sin(3 * FRAME.a) + 0.1 * FRAME.b, 0.01
X, y, v = FRAME[["a", "b"]], FRAME["y"], FRAME["v"]
WAVE = FormulaPhysics("sin(3*a)", ["a", "b"])


@pytest.mark.parametrize("cls", [CKA, PhysicsMeanGP, ZeroMeanGP])
def test_targets_and_variances_are_series(cls):
    physics = {} if cls is ZeroMeanGP else {"physics": WAVE}
    model, frames = (cls(X, Y, Yvar, **physics) for Y, Yvar in ((y, v), (FRAME[["y"]],) * 2))
    assert torch.equal(model.data.Y, frames.data.Y)
    assert model.data.output_names == ("y",)
    assert model.data.Yvar.shape == (9, 1)
    more = model.condition_on_observations(X[:2], y[:2], noise=v[:2])
    assert len(more.data.X) == 11


def test_a_series_of_inputs_is_one_column():
    model = CKA(FRAME["a"], y, physics=FormulaPhysics("sin(3*a)", ["a"]))
    fit(model, "map")
    found = model.predict(FRAME["a"]).mean
    assert isinstance(found, pd.DataFrame)
    pd.testing.assert_frame_equal(found, model.predict(FRAME[["a"]]).mean)


def test_a_variance_for_each_output_may_be_a_series():
    outputs = FRAME[["y", "b"]]
    model = ZeroMeanGP(X, outputs, outputs.var())
    assert model.data.Yvar[3].tolist() == outputs.var().tolist()


@pytest.mark.slow
def test_comparisons_regressors_and_records_take_series():
    assert "y" in repr(compare(X, y, WAVE, v))
    assert CKARegressor(physics=WAVE).fit(X, y, train_Yvar=v).score(X, y) > 0
    record = Record(0.1 * np.arange(9), FRAME["y"], FRAME["b"])
    assert record.states.shape == record.actions.shape == (9, 1)


def test_times_of_a_record_are_dates_in_texts():
    texts = pd.Series([f"2015-02-13 23:59:{50 + k}" for k in range(9)])
    record = Record(texts, FRAME[["y"]], FRAME[["b"]])
    assert record.times.tolist() == [*range(9)]
    with pytest.raises(TypeError, match=r"convert numbers in text with `.astype\(float\)`"):
        Record(pd.Series(["1", "2"]), FRAME[["y"]][:2], FRAME[["b"]][:2])
