"""The options of a model, which say what the data are, wherever the house makes models.

A kind of data is a row of KINDS: its options, and what is true of a model that has them.
"""

import sys
from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch
from botorch.acquisition import qNegIntegratedPosteriorVariance
from botorch.models.transforms.outcome import Standardize
from gpytorch.constraints import GreaterThan
from gpytorch.likelihoods import GaussianLikelihood
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV

from gpadjust import CKA, compare, fit, load, save
from gpadjust.active import collect
from gpadjust.dynamics import LearnedDynamics, StateSpec
from gpadjust.models.factory import with_options
from gpadjust.report import report
from gpadjust.report.markup import Markup
from gpadjust.sklearn import CKARegressor

KINDS = {
    "a likelihood": (
        {"likelihood": GaussianLikelihood(noise_constraint=GreaterThan(1e-5))},
        lambda model: model.likelihood.noise_covar.raw_noise_constraint.lower_bound < 2e-5,
    ),
    "other units": (
        {"outcome_transform": Standardize(m=1)},
        lambda model: model.outcome_transform.means.abs().max() > 0.1,
    ),
    "noisy inputs": (
        {"train_Xvar": 1e-4},
        lambda model: model.noisy_inputs is not None,
    ),
    "units as they are": (
        {"outcome_transform": None},
        lambda model: getattr(model, "outcome_transform", None) is None,
    ),
    "positive outputs": ({"outcome_transform": "log"}, lambda model: "log" in model.link.formula),
    "outliers": (
        {"likelihood": "heavy-tailed"},
        lambda model: model.options["likelihood"] == "heavy-tailed",
    ),
    "relative noise and outliers": (
        {"likelihood": ["relative", "heavy-tailed"]},
        lambda model: "relative" in model.options["likelihood"],
    ),
    "categories": ({"categorical": [1]}, lambda model: model.input_transform is not None),
    "batches": ({"batch": [1]}, lambda model: model.input_transform is not None),
    "bounded outputs": ({"outcome_transform": (0.0, 9.0)}, lambda model: "9" in model.link.formula),
}
QUICK = {"num_starts": 1, "num_screened": 8}
MAP = {"method": "map", **QUICK}


def f_p(X):
    return 3 + X[:, :1].sin()


@pytest.fixture(params=[pytest.param(kind, id=name) for name, kind in KINDS.items()])
def kind(request):
    return request.param


@pytest.fixture
def data():
    x = torch.linspace(0, 3, 12, dtype=torch.float64).unsqueeze(-1)
    rig = torch.arange(12).remainder(3).unsqueeze(-1).double()
    Y = 1.2 * f_p(x) + 0.1 * x + 0.02 * torch.randn_like(x)
    return torch.cat([x, rig], dim=-1), Y


@pytest.mark.slow
def test_compare_and_its_page(kind, data, tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules["gpadjust.validation.comparison"], "_DRAWS", (32, 32))
    monkeypatch.setattr("gpadjust.report.sections.drawn", lambda draw: Markup())
    options, has = kind
    found = compare(*data, f_p, structures=["zero mean", "CKA"], **QUICK, **options)
    assert len(found.models) == 2
    assert all(map(has, found.models.values()))
    loo = found.leave_one_out()
    assert (loo.Y - data[1]).abs().max() < 1e-9
    assert loo.score().coverage.item() >= 0.75
    assert report(found, tmp_path / "page.html").stat().st_size > 10_000
    given = {name: each for name, each in options.items() if isinstance(each, torch.nn.Module)}
    save(found.stacked, tmp_path / "stacked.pt")
    for model, file in ((found.recommended, "page.pt"), (found.stacked, "stacked.pt")):
        again = load(tmp_path / file, physics=f_p, **given)
        for ours, theirs in zip(again.interval(data[0]), model.interval(data[0]), strict=True):
            assert torch.allclose(ours, theirs)


@pytest.mark.slow
def test_regressor(data):
    options, has = KINDS["relative noise and outliers"]
    X, y = data[0].numpy(), data[1].numpy()[:, 0]
    regressor = CKARegressor(
        lambda X: 3 + np.sin(X[:, 0]), model_options=options, fit_method="map", fit_options=QUICK
    )
    search = GridSearchCV(regressor, {"model_options": [options]}, cv=2).fit(X, y)
    assert has(search.best_estimator_.model_)
    fitted = clone(regressor).fit(X, y)
    assert has(fitted.model_)
    assert np.abs(fitted.predict(X) - y).max() < 0.2


@pytest.mark.slow
def test_a_frame_with_texts_in_a_search(data):
    frame = pd.DataFrame(data[0].numpy(), columns=["time", "rig"])
    frame["rig"] = frame["rig"].map({0.0: "old", 1.0: "new", 2.0: "lent"})
    y = data[1][:, 0].numpy()
    regressor = CKARegressor(
        lambda X: 3 + np.sin(X[:, 0]), fit_method="map", fit_options=QUICK, random_state=0
    )
    options = {"model_options": [{}, {"batch": ["rig"]}]}
    search = GridSearchCV(regressor, options, cv=2, error_score="raise").fit(frame, y)
    assert np.abs(search.predict(frame) - y).max() < 0.2
    assert [*search.feature_names_in_] == ["time", "rig"]
    other = frame.assign(rig="another")
    batches = regressor.set_params(model_options={"batch": "rig"}).fit(frame, y)
    assert np.isfinite(batches.predict(other)).all()
    plain = regressor.set_params(model_options=None).fit(frame, y)
    with pytest.raises(ValueError, match="Expected rig to be one of lent, new, old, got 'another'"):
        plain.predict(other)


@pytest.mark.slow
def test_collection(tmp_path):
    options, has = KINDS["positive outputs"]
    call = partial(
        collect,
        with_options(partial(CKA, physics=f_p), options),
        lambda X: 1.2 * f_p(X),
        [[0.0], [3.0]],
        lambda model: qNegIntegratedPosteriorVariance(model, torch.rand(4, 1).double()),
        fit=lambda model: fit(model, **MAP),
        optimizer_options={"num_restarts": 1, "raw_samples": 4},
        log=tmp_path / "log.jsonl",
    )
    assert has(call(budget=6).model)
    assert has(call(budget=7).model)  # goes on from the log


@pytest.mark.slow
def test_dynamics(kind):
    options, has = kind
    spec = StateSpec(["x"], ["v"])

    def build():
        model = with_options(CKA, options)
        return LearnedDynamics(spec, f_p, model=model, target="absolute", fit_options=MAP)

    dynamics = build()
    x, v = torch.rand(10, 1).double(), torch.arange(10).remainder(2).unsqueeze(-1).double()
    for _ in range(2):
        dynamics.update(x, v, f_p(x) + 0.1 * v)
    assert has(dynamics.model)
    again = build()
    again.load_state_dict(dynamics.state_dict())
    assert has(again.model)
    assert torch.allclose(again.predict(x, v).mean, dynamics.predict(x, v).mean)


def test_what_a_structure_says_itself_it_keeps(data):
    own = partial(CKA, outcome_transform=None)
    found = compare(*data, f_p, structures=[own], **QUICK, outcome_transform=Standardize(m=1))
    (model,) = found.models.values()
    assert getattr(model, "outcome_transform", None) is None


def test_options_that_are_none(data):
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'noise'.*it takes"):
        compare(*data, f_p, noise=0.1)
    X, y = data[0].numpy(), data[1].numpy()
    with pytest.raises(TypeError, match=r"Expected model_options as a dictionary.*'relative'"):
        CKARegressor(model_options="relative").fit(X, y)
    with pytest.raises(TypeError, match=r"'physics' in model_options.*argument of its own"):
        CKARegressor(model_options={"physics": f_p}).fit(X, y)


def test_variances_of_rows_go_with_the_rows(data):
    X, y = data[0].numpy(), data[1].numpy()[:, 0]
    variances = np.linspace(0.01, 0.1, len(y))
    regressor = CKARegressor(fit_method="map", fit_options=QUICK)
    fitted = regressor.fit(X[:8], y[:8], train_Yvar=variances[:8])
    assert np.allclose(fitted.model_.data()["train_Yvar"][:, 0], variances[:8])
    search = GridSearchCV(regressor, {"random_state": [0]}, cv=2, error_score="raise")
    assert np.isfinite(search.fit(X, y, train_Yvar=variances).best_score_)
