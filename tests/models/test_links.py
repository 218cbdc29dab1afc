"""Positive and bounded outputs: a link, with the physics through it."""

from functools import partial

import pytest
import torch
from botorch.models.transforms.outcome import Log

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, StackedGP, compare, fit, load, save
from gpadjust.models import Logit
from gpadjust.physics import FunctionPhysics, PhysicsError, Unknown
from gpadjust.validation import leave_one_out, score
from tests.systems import line

X = line(12) + 0.1
NEW = torch.tensor([[0.05], [0.5], [2.5]], dtype=torch.float64)
NOISE = torch.randn(12, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def decades(X):
    return (6 * X[:, :1]).exp()


def share(X):
    return X[:, :1] / (1 + X[:, :1])


Y = 3 * decades(X) ** 1.1 * (0.05 * NOISE).exp()
SHARES = (2 * share(X).logit() + 0.05 * NOISE).sigmoid()


@pytest.fixture(scope="module")
def log_model():
    model = CKA(X, Y, physics=decades, outcome_transform=Log())
    fit(model, num_samples=4)
    return model


def test_it_is_the_model_of_the_logarithms(log_model):
    plain = CKA(X, Y.log(), physics=lambda X: decades(X).log())
    fit(plain, num_samples=4)
    means, variances = plain.components(NEW, True)
    mean = (means + variances / 2).exp().mean(0)
    second = (2 * means + 2 * variances).exp().mean(0)
    found = log_model.predict(NEW, observation_noise=True)
    torch.testing.assert_close(found.mean, mean)
    torch.testing.assert_close(found.variance, second - mean.square())
    for own, other in zip(log_model.interval(NEW), plain.interval(NEW), strict=True):
        torch.testing.assert_close(own, other.exp())
    torch.testing.assert_close(log_model.fallback(NEW), decades(NEW))
    torch.testing.assert_close(log_model.log_evidence()[1], plain.log_evidence()[1] - Y.log().sum())
    loo, other = leave_one_out(log_model), leave_one_out(plain)
    torch.testing.assert_close(loo.log_density, other.log_density - Y.log())
    torch.testing.assert_close(loo.Y, Y)
    assert loo.score().coverage == ((loo.below() - 0.5).abs() <= 0.475).double().mean()


def test_functions_and_draws_have_the_moments(log_model):
    torch.manual_seed(0)
    mean, variance = log_model.predict(NEW[:2])
    draws = log_model.posterior(NEW[:2]).rsample(torch.Size([4000])).flatten(0, 1)
    functions = log_model.sample_functions(500, seed=0)(NEW[:2])
    for values in (draws, functions):
        assert (values > 0).all()
        torch.testing.assert_close(values.mean(0), mean, rtol=0.05, atol=0)
        torch.testing.assert_close(values.std(0), variance.sqrt(), rtol=0.25, atol=0)
    levels = torch.tensor([0.025, 0.975], dtype=torch.float64)
    quantiles = log_model.posterior(NEW).quantile(levels)
    torch.testing.assert_close(torch.stack(log_model.interval(NEW)), quantiles)
    scores = score(log_model.posterior(X, observation_noise=True), Y)
    assert scores.nlpd.isfinite().all()
    assert scores.coverage > 0.8
    with pytest.raises(NotImplementedError, match="no normal posterior"):
        _ = log_model.posterior(NEW).distribution


def test_moments_of_a_bounded_output():
    link, generator = Logit(2.0, 5.0), torch.Generator().manual_seed(0)
    mean = torch.tensor([-8.0, 0.0, 1.0], dtype=torch.float64)
    variance = torch.tensor([9.0, 0.01, 100.0], dtype=torch.float64)
    z = torch.randn(400_000, 1, generator=generator, dtype=torch.float64)
    y = 2 + 3 * torch.sigmoid(mean + z * variance.sqrt())
    found = link.moments(mean, variance)
    torch.testing.assert_close(found[0], y.mean(0), rtol=1e-3, atol=0)
    torch.testing.assert_close(found[1], y.var(0), rtol=0.02, atol=0)
    inside = torch.tensor([2.1, 3.0, 4.9], dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(link.inverse(link.value(inside)), inside)
    (slope,) = torch.autograd.grad(link.value(inside).sum(), inside)
    torch.testing.assert_close(link.log_slope(inside.detach()), slope.log())


@pytest.mark.parametrize("given", ["logit", (0.0, 1.0), Logit()], ids=["name", "pair", "link"])
def test_the_ways_to_say_it(given, tmp_path):
    model = CKA(X, SHARES, physics=share, outcome_transform=given)
    fit(model, "map", num_starts=2)
    lower, upper = model.interval(torch.tensor([[1e-6], [50.0]]).double(), 0.9999)
    assert (lower > 0).all()
    assert (upper < 1).all()
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", trusted=True)
    torch.testing.assert_close(again.predict(NEW).mean, model.predict(NEW).mean)
    assert "log(y / (1 - y))" in again.summary()
    conditioned = model.condition_on_observations(NEW[2:], share(NEW[2:]))
    torch.testing.assert_close(conditioned.data()["train_Y"][-1:], share(NEW[2:]))
    assert (conditioned.predict(NEW[2:]).variance < model.predict(NEW[2:]).variance).all()


def test_known_variances_by_the_delta_method():
    variances = (0.05 * Y).square()
    model = CKA(X, Y, variances, physics=decades, outcome_transform="log")
    known = model.likelihood.noise * model.units()[1].square()
    torch.testing.assert_close(known, torch.full_like(known, 0.0025))
    torch.testing.assert_close(model.data()["train_Yvar"], variances)
    more = model.condition_on_observations(NEW, decades(NEW), noise=0.0025 * decades(NEW).square())
    assert more.predict(NEW).mean.shape == (3, 1)
    mean, variance = model.components(NEW, False)
    given = model.components(NEW, 0.01 * mean[0].exp().square())[1]
    torch.testing.assert_close(given - variance, torch.full_like(given, 0.01))


def test_unknown_parameters_and_missing_observations():
    law = FunctionPhysics(
        lambda X, p: torch.stack([(p.a * X[:, 0]).exp(), (-p.a * X[:, 0]).exp()], -1),
        unknowns={"a": Unknown(3.0, factor=2.0)},
    )
    seen = torch.cat([decades(X), 1 / decades(X)], -1)
    seen[3, 1] = torch.nan
    model = CalibratedPhysics(X, seen, physics=law, outcome_transform="log")
    fit(model, num_samples=16)
    torch.testing.assert_close(model.physics_parameters.mean, torch.tensor([6.0]).double())
    assert leave_one_out(model).log_density.isnan().sum() == 1
    assert model.log_evidence()[1].isfinite().all()


@pytest.mark.slow
def test_links_are_compared_and_stacked():
    comparison = compare(X, Y, decades, structures=[CKA, PhysicsMeanGP], outcome_transform="log")
    stacked = StackedGP(comparison.models, torch.tensor([[0.25], [0.75]]).double(), 8)
    moments = [part.model.predict(NEW).mean for part in stacked.parts[0]]
    torch.testing.assert_close(
        stacked.predict(NEW).mean, 0.25 * moments[0] + 0.75 * moments[1], rtol=0.05, atol=0.05
    )
    lower, upper = stacked.interval(NEW)
    quantiles = stacked.posterior(NEW).quantile(torch.tensor([0.025, 0.975]).double())
    torch.testing.assert_close(torch.stack([lower, upper]), quantiles, rtol=1e-4, atol=1e-4)
    functions = stacked.sample_functions(400, seed=0)(NEW)
    torch.testing.assert_close(
        functions.median(0).values,
        stacked.posterior(NEW).quantile(torch.tensor([0.5]).double()),
        rtol=0.1,
        atol=0.1,
    )
    assert leave_one_out(stacked).pit is not None
    with pytest.raises(ValueError, match="got variances"):
        stacked.predict(NEW, torch.ones_like(NEW))
    with pytest.raises(ValueError, match="Expected models of one link"):
        compare(X, Y, decades, structures=[CKA, partial(CKA, outcome_transform="log")])


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"train_Y": Y - 10}, ValueError, "train_Y above 0.*found .* in row 0"),
        ({"outcome_transform": "logit"}, ValueError, "above 0 and below 1"),
        ({"outcome_transform": "logarithm"}, ValueError, "'log', 'logit'"),
        ({"outcome_transform": (1.0,)}, ValueError, "two bounds"),
        ({"outcome_transform": (1.0, 0.0)}, ValueError, "below the upper"),
        ({"outcome_transform": ("a", 1.0)}, TypeError, "two numbers"),
        ({"outcome_transform": Log(outputs=[0])}, ValueError, "all outputs"),
        ({"physics": lambda X: X - 0.5}, PhysicsError, "above 0, as log.*clamp"),
    ],
)
def test_bad_input(options, error, message):
    given = {"train_Y": Y, "physics": decades, "outcome_transform": "log"} | options
    with pytest.raises(error, match=f"(?s){message}"):
        PhysicsMeanGP(X, given.pop("train_Y"), **given)


def test_errors_of_new_points(log_model):
    with pytest.raises(ValueError, match="Y above 0"):
        log_model.condition_on_observations(NEW, -NEW)
    model = CKA(X, Y, physics=lambda X: decades(X) - 1, outcome_transform="log")
    with pytest.raises(PhysicsError, match=r"row 1: \[-1.0\]"):
        model.predict(torch.tensor([[1.0], [-1.0]]).double())
