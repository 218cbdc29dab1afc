"""Noise by name through the whole house: relative to the physics, and with heavy tails."""

import math

import pytest
import torch

from gpadjust import CKA, RRA, VariationalCKA, ZeroMeanGP, compare, fit, load, save
from gpadjust.models import Logit
from gpadjust.models.heavy_tails import SHARE
from gpadjust.report import report
from gpadjust.validation import leave_one_out
from tests.systems import refused

OPTIONS = {"num_draws": 64, "num_starts": 2, "num_screened": 16}
OUTLIERS = [4, 13]


def decades(X):
    return torch.exp(6 * X[:, :1] - 4)


def wave(X):
    return torch.sin(5 * X[:, :1])


@pytest.fixture
def growing():
    torch.manual_seed(0)
    X = torch.linspace(0.02, 1, 24, dtype=torch.float64).unsqueeze(-1)
    return X, decades(X) * (1 + 0.2 * X) * (1 + 0.1 * torch.randn_like(X))


@pytest.fixture
def gross():
    torch.manual_seed(1)
    X = torch.linspace(0, 1, 20, dtype=torch.float64).unsqueeze(-1)
    Y = wave(X) + 0.3 * X + 0.03 * torch.randn_like(X)
    Y[OUTLIERS] += torch.tensor([[0.6], [-3.0]], dtype=torch.float64)
    return X, Y


def test_relative_noise_is_that_of_the_formula(growing):
    X, Y = growing
    model = CKA(X, Y, physics=decades, likelihood="relative")
    fit(model, **OPTIONS)
    new = torch.tensor([[0.1], [0.9]], dtype=torch.float64)
    said = model.likelihood.said(model.units()[1].squeeze(-1))
    constant, relative = (each.detach() for each in said)
    expected = (constant[:, None].square() + (relative[:, None] * decades(new).mT).square()).mean(0)
    more = [model.components(new, noisy)[1].mean(0).squeeze(-1) for noisy in (True, False)]
    assert torch.allclose(more[0] - more[1], expected)
    assert 0.06 < float(relative.median()) < 0.16
    model = ZeroMeanGP(X, Y, likelihood="relative")
    fit(model, **OPTIONS)
    sd = (model.predict(X, True).variance - model.predict(X).variance).sqrt().flatten()
    assert float(sd[-1] / sd[0]) > 8  # of equal noise it would be 1


def test_outliers_are_found_and_hardly_count(gross):
    X, Y = gross
    model = CKA(X, Y, physics=wave, likelihood="heavy-tailed")
    fit(model, **OPTIONS)
    assert (model.outliers() > 0.5).flatten().nonzero().flatten().tolist() == OUTLIERS
    assert "outliers: rows 4, 13" in model.summary()
    truth = wave(X) + 0.3 * X
    assert float((model.predict(X).mean - truth).abs().max()) < 0.15
    loo = leave_one_out(model)
    # The density of a residual r far out is that of the tails, SHARE / (2 |r| log 1000).
    r = float((loo.Y - loo.mean)[13].abs())
    tail = math.log(SHARE / (2 * r * math.log(1e3)))
    assert float(loo.log_density[13]) == pytest.approx(tail, abs=0.1)
    assert float(loo.score().rmse) < 0.1


@pytest.mark.slow
def test_without_outliers_nothing_changes(gross):
    X, Y = gross
    keep = [i for i in range(len(X)) if i not in OUTLIERS]
    models = [
        CKA(X[keep], Y[keep], physics=wave, likelihood=name) for name in (None, "heavy-tailed")
    ]
    for model in models:
        fit(model, **OPTIONS)
    means = [model.predict(X).mean for model in models]
    assert torch.allclose(*means, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("names", ["relative", "heavy-tailed", ["relative", "heavy-tailed"]])
def test_the_whole_house(names, gross, tmp_path):
    X, Y = gross
    two = torch.cat([Y, Y.flip(0)], dim=-1)
    f_p = lambda X: torch.cat([wave(X), wave(1 - X)], dim=-1)  # noqa: E731
    model = CKA(X, two, physics=f_p, likelihood=names)
    fit(model, **OPTIONS)
    with pytest.warns(UserWarning, match="lambda"):
        save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", physics=f_p)
    for read in (lambda m: m.posterior(X).variance, lambda m: m.interval(X, 0.9, True)[0]):
        assert torch.equal(read(model), read(again))
    second = model.subset_output([1])
    assert torch.allclose(second.predict(X, True).variance, model.predict(X, True).variance[:, 1:])
    assert model.sample_functions(2)(X).shape == (2, 20, 2)
    one = torch.tensor([[0.51]], dtype=torch.float64)
    truth = f_p(one) + 0.3 * torch.cat([one, 1 - one], dim=-1)
    more = model.condition_on_observations(one, truth)
    assert bool((more.predict(one).variance < model.predict(one).variance).all())
    before = fit(model, "map")
    assert before.converged.shape == (2,)


@pytest.mark.slow
def test_a_page_tells_outliers(gross, tmp_path):
    found = compare(*gross, physics=wave, likelihood="heavy-tailed", structures=["CKA"])
    assert "outlier" in report(found, tmp_path / "page.html").read_text().lower()


@pytest.mark.parametrize(
    ("kind", "known"), [(CKA, 0.03**2), pytest.param(RRA, None, marks=pytest.mark.slow)]
)
def test_random_features_and_known_noise_have_outliers_too(gross, kind, known):
    X, Y = gross
    model = kind(X, Y, known, physics=wave, likelihood="heavy-tailed")
    fit(model, **OPTIONS)
    assert bool((model.outliers()[OUTLIERS] > 0.5).all())


def test_bad_input(gross):
    X, Y = gross
    f_p, logit = {"physics": wave}, Logit(0, 99)
    refused(ValueError, "a sequence of both, or a Ga", CKA, X, Y, **f_p, likelihood="Student")
    options = {"physics": lambda X: X + 9, "outcome_transform": logit, "likelihood": "relative"}
    refused(ValueError, "relative already", CKA, X, Y + 9, **options)
    refused(ValueError, "train_Yvar or a like", CKA, X, Y, 0.1, **f_p, likelihood="relative")
    sparse = {"likelihood": "heavy-tailed", "num_inducing": 5}
    refused(ValueError, "one variance for all", VariationalCKA, X, Y, **f_p, **sparse)
    refused(ValueError, "heavy-tailed", CKA(X, Y, physics=wave).outliers)
