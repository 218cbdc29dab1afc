"""The options that say what the data are, wherever the house makes models.

A kind of data is a row of KINDS: its options, and what is true of a model that has them.
"""

from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch
from botorch.acquisition import qNegIntegratedPosteriorVariance
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV

from gpadjust import CKA, compare, fit, load, save
from gpadjust.active import collect
from gpadjust.dynamics import LearnedDynamics, StateSpec
from gpadjust.kinds import Categories, HeavyTails, RelativeNoise, with_options
from gpadjust.sklearn import CKARegressor
from tests.systems import line, normal, same


def has_outliers(model):
    return isinstance(model.noise, HeavyTails) and model.noise.is_outlier is not None


KINDS = {
    "relative noise and outliers": (
        {"noise": HeavyTails(base=RelativeNoise())},
        lambda model: has_outliers(model) and isinstance(model.noise.base, RelativeNoise),
    ),
    "positive outputs": ({"link": "log"}, lambda model: "log" in model.scale_formula),
    "bounded outputs": ({"link": (0.0, 9.0)}, lambda model: "9" in model.scale_formula),
    "categories": (
        {"input_transform": Categories([1])},
        lambda model: model.data.transform.levels[1] == (0.0, 1.0, 2.0),
    ),
    "batches": (
        {"input_transform": Categories([], batches=[1])},
        lambda model: len(model.terms) == 3 and model.data.transform.batches == [1],
    ),
}


def f_p(X):
    return 3 + X[:, :1].sin()


@pytest.fixture
def data():
    """A time and one of three rigs."""
    x, rig = line(12, 0, 3), torch.arange(12).remainder(3).unsqueeze(-1).double()
    Y = 1.2 * f_p(x) + 0.1 * x + 0.02 * normal(12, 1)
    return torch.cat([x, rig], -1), Y


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_compare_and_files(name, data, tmp_path):
    options, has = KINDS[name]
    variances = 0.02**2 * torch.ones_like(data[1]) if name == "categories" else None
    found = compare(*data, f_p, variances, structures=["physics mean", "CKA"], **options)
    assert len(found.models) == 2
    assert all(map(has, found.models.values()))
    assert variances is None or torch.equal(found.models["CKA"].data.Yvar, variances)
    loo = found.leave_one_out()
    assert (loo.Y - data[1]).abs().max() < 1e-9
    assert loo.score().coverage.item() >= 0.75
    for model in (found.recommended, found.stacked):
        save(model, tmp_path / "model.pt")
        again = load(tmp_path / "model.pt", physics=f_p)
        same(again.interval(data[0]), model.interval(data[0]))


@pytest.mark.slow
def test_a_frame_with_texts_in_a_search(data):
    frame = pd.DataFrame(data[0].numpy(), columns=["time", "rig"])
    frame["rig"] = frame["rig"].map({0.0: "old", 1.0: "new", 2.0: "lent"})
    y = data[1][:, 0].numpy()
    regressor = CKARegressor(lambda X: 3 + np.sin(X[:, 0]), fit_method="map", random_state=0)
    batches = {"input_transform": Categories([], batches=["rig"])}
    search = GridSearchCV(regressor, {"model_options": [{}, batches]}, cv=2, error_score="raise")
    search.fit(frame, y)
    assert np.abs(search.predict(frame) - y).max() < 0.2
    assert [*search.feature_names_in_] == ["time", "rig"]
    other = frame.assign(rig="another")
    fitted = clone(regressor).set_params(model_options=batches).fit(frame, y)
    assert np.isfinite(fitted.predict(other)).all()
    with pytest.raises(ValueError, match="another"):
        regressor.fit(frame, y).predict(other)


@pytest.mark.slow
def test_collection(tmp_path):
    options, has = KINDS["positive outputs"]
    call = partial(
        collect,
        with_options(partial(CKA, physics=f_p), options),
        lambda X: 1.2 * f_p(X),
        [[0.0], [3.0]],
        lambda model: qNegIntegratedPosteriorVariance(model, torch.rand(4, 1).double()),
        fit=lambda model: fit(model, "map"),
        optimizer_options={"num_restarts": 1, "raw_samples": 4},
        log=tmp_path / "log.jsonl",
    )
    assert has(call(budget=6).model)
    assert has(call(budget=7).model)  # goes on from the log


@pytest.mark.slow
@pytest.mark.parametrize("name", ["relative noise and outliers", "bounded outputs"])
def test_dynamics(name):
    options, has = KINDS[name]
    spec = StateSpec(["x"], ["v"])

    def build():
        model = with_options(CKA, options)
        return LearnedDynamics(
            spec, f_p, model=model, target="absolute", fit_options={"method": "map"}
        )

    dynamics = build()
    x, v = line(12), torch.arange(12).remainder(3).unsqueeze(-1).double()
    for _ in range(2):
        dynamics.update(x, v, f_p(x) + 0.1 * v)
    assert has(dynamics.model)
    again = build()
    again.load_state_dict(dynamics.state_dict())
    assert has(again.model)
    assert torch.allclose(again.predict(x, v).mean, dynamics.predict(x, v).mean)


def test_an_option_that_models_do_not_have(data):
    with pytest.raises(TypeError, match="Unknown option 'likelihood'"):
        compare(*data, f_p, likelihood=0.1)
