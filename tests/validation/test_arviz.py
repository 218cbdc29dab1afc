"""Draws for ArviZ: groups, names and units, and what its functions make of them."""

import sys

import matplotlib
import pandas
import pytest
import torch

from gpadjust import CKA, ZeroMeanGP, fit
from gpadjust.core import StackedGP
from gpadjust.validation import to_arviz
from tests.systems import line, normal, refused, wave

matplotlib.use("Agg")
if tuple(map(int, matplotlib.__version__.split(".")[:2])) >= (3, 11):
    pytest.skip("ArviZ 0.8 cannot be imported with matplotlib 3.11", allow_module_level=True)
plots = pytest.importorskip("arviz_plots")
stats = pytest.importorskip("arviz_stats")


@pytest.fixture(scope="module")
def models():
    X = line(14)
    Y = 20 * wave(X) + 10 * X + normal(14, 1)
    models = [CKA(X, Y, physics=lambda X: 10 * wave(X)) for _ in range(2)]
    for seed, model in enumerate(models):
        fit(model, seed=seed)
    return models


def test_groups_have_the_names_and_units_of_the_summary(models):
    tree = to_arviz(*models)
    groups = {"posterior", "prior", "log_likelihood", "observed_data", "posterior_predictive"}
    assert {*tree.children} == groups
    assert dict(tree.posterior.sizes) == {"chain": 2, "draw": len(models[0].draws)}
    assert {*tree.posterior.data_vars} == {*models[0].priors()["name"]} == {*tree.prior.data_vars}
    noise = tree.posterior["noise standard deviation"].to_numpy()
    assert 0.5 < float(noise[0].mean()) < 2
    medians = tree.prior.median()
    for row in models[0].priors().itertuples():
        if row.name != "rho center":
            assert float(medians[row.name]) == pytest.approx(row.median, rel=1.5)
    assert tree.observed_data["y"].shape == (14,)
    assert tree.posterior_predictive["y"].shape == (2, len(models[0].draws), 14)


@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto")
def test_arviz_works_on_it(models):
    tree = to_arviz(*models)
    for plot in (plots.plot_trace, plots.plot_dist, plots.plot_ppc_dist, plots.plot_loo_pit):
        assert plot(tree, backend="matplotlib").viz is not None
    loo, summary = stats.loo(tree), stats.summary(tree)
    left_out = models[0].left_out()
    lppd = float(left_out.log_density(models[0].data.Y).sum())
    assert loo.elpd + loo.p == pytest.approx(lppd, abs=2)
    assert "noise standard deviation" in summary.index


def test_outputs_and_missing_targets():
    X = line(10)
    Y = torch.cat([wave(X), 2 * wave(X)], 1)
    Y[3, 1] = torch.nan
    model = ZeroMeanGP(X, Y)
    fit(model)
    tree = to_arviz(model, chains=2)
    assert "y2: noise standard deviation" in tree.posterior
    assert tree.log_likelihood["y1"].shape == (2, len(model.draws) // 2, 10)
    assert tree.observed_data["y2"].shape == (9,)


def test_names_with_a_stroke():
    X = line(8)
    frames = [pandas.DataFrame({"v [m/s]": X[:, 0]}), pandas.DataFrame({"k [N/mm]": wave(X)[:, 0]})]
    model = ZeroMeanGP(*frames)
    fit(model)
    tree = to_arviz(model)
    assert tree.observed_data["k [N\u2215mm]"].dims == ("k [N\u2215mm] row",)
    assert {*tree.log_likelihood.data_vars} == {"k [N\u2215mm]"}
    assert any("v [m\u2215s]" in name for name in tree.posterior.data_vars)


def test_refused(models, monkeypatch):
    refused(ValueError, "fits of one model", to_arviz)
    refused(TypeError, "one of its `models`", to_arviz, StackedGP({"a": models[0]}, torch.ones(1)))
    refused(ValueError, "multiple of 3", to_arviz, models[0], chains=3)
    monkeypatch.setitem(sys.modules, "arviz_base", None)
    refused(ImportError, r"gpadjust\[arviz\]", to_arviz, *models)
