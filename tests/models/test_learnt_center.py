"""A center that is learnt: the models of fixed centers, and offsets that make no difference."""

import pytest
import torch

from gpadjust import CKA, RRA, fit
from gpadjust.inference.warm_start import warm_start


def crude(X):
    return 5 + (3 * X[..., :1]).sin() + X[..., 1:].square()


@pytest.fixture
def XY(uniform):
    X = uniform(9, 2)
    noise = 0.05 * torch.randn(9, 1, generator=torch.Generator().manual_seed(0))
    return X, (1 + X[:, :1]) * crude(X) + X[:, 1:] + noise.double()


def move(model, center):
    """Bring the learnt center to a number in the user's units."""
    for term in model.terms:
        if term.name == "rho":
            basis = term.basis
            with torch.no_grad():
                basis.center.copy_(basis.center_at(torch.full_like(basis.offset, center)))
    return model.eval()


@pytest.mark.parametrize("center", [0.0, 5.5, -3.0])
@pytest.mark.parametrize("cls", [CKA, RRA])
def test_it_is_the_model_of_a_fixed_center(XY, uniform, close, cls, center):
    X, Y = XY
    Z = uniform(6, 2, seed=1)
    options = {"num_features": 16, "seed": 0} if cls is RRA else {}
    model = cls(X, Y, physics=crude, center="learn", **options)
    fixed = cls(X, Y, physics=crude, center=center, **options)
    named = dict(model.named_parameters())
    with torch.no_grad():
        for name, parameter in fixed.named_parameters():
            if parameter.requires_grad:
                named[name].copy_(parameter)
    move(model, center)
    pairs = [(each.posterior(Z), each.rho(Z), each.delta(Z)) for each in (model, fixed.eval())]
    for actual, expected in zip(*pairs, strict=True):
        close(actual.mean, expected.mean)
        close(actual.variance, expected.variance)
    assert model.term_mean("delta") == pytest.approx(0.0, abs=1e-9)
    assert model.term_mean("rho") == pytest.approx(1.0)


def test_the_prior_mean_is_the_physics_wherever_the_center_is(XY):
    X, Y = XY
    model = CKA(X, Y, physics=crude, center="learn")
    far = 1e3 + X
    for center in (0.0, 7.0):
        torch.testing.assert_close(move(model, center).posterior(far).mean, crude(far))
    model = move(CKA(*XY, physics=crude, center="learn"), 4.25)
    assert "center 4.25" in model.summary()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["map", "bayes"])
def test_an_offset_of_targets_and_physics_changes_nothing(XY, uniform, method):
    X, Y = XY
    Z, found = uniform(20, 2, seed=1), []
    # Rounding errors change which draws are made: enough of them say the same.
    draws = {"num_samples": 256, "num_draws": 2048} if method == "bayes" else {}
    for offset in (0.0, 720.0):
        model = CKA(X, Y + offset, physics=lambda X, c=offset: crude(X) + c, center="learn")
        fit(model, method, num_screened=32, **draws)
        mean, variance = model.predict(Z)
        found.append((mean - offset, variance.sqrt()))
    (mean, sd), (shifted, other) = found
    assert ((mean - shifted).abs() < 0.3 * sd + 1e-6).all()
    assert ((sd / other).log().abs() < 0.3).all()


def test_a_center_that_is_right_is_found(uniform):
    # y = rho(x) (f_p - 8) with a rho that varies much, about f_p of a mean of 5.
    X = uniform(30, 2)
    Y = crude(X) + X[:, :1].exp().sin() * (crude(X) - 8)
    model = CKA(X, Y, physics=crude)
    fit(model)
    assert (model.terms[0].basis.origin - 8).abs().max() < 0.3


def test_later_models(XY, uniform):
    X, Y = XY
    model = move(CKA(X, Y, physics=crude, center="learn"), 4.2)
    more = uniform(12, 2, seed=3)
    later = CKA(more, 2 * crude(more), physics=crude, center="learn")
    warm_start(later, model)
    torch.testing.assert_close(later.terms[0].basis.origin, model.terms[0].basis.origin)
    model = CKA(X, Y, physics=lambda X: 2.0 + 0 * X[..., :1], center="learn")
    fit(model, num_screened=8, num_draws=64)
    assert model.predict(X).mean.isfinite().all()
    warm_start(CKA(X, Y, physics=lambda X: 2.0 + 0 * X[..., :1], center="learn"), model)


@pytest.mark.parametrize("method", ["map", "bayes"])
def test_one_that_is_held_fixed_stays(XY, method):
    model = move(CKA(*XY, physics=crude, center="learn"), 4.0)
    model.terms[0].basis.center.requires_grad_(False)
    fit(model, method, num_screened=16)
    expected = torch.full_like(model.terms[0].basis.origin, 4.0)
    torch.testing.assert_close(model.terms[0].basis.origin, expected)


def test_a_point_fit_and_predictions_leave_it(XY, uniform):
    models = [CKA(*XY, physics=crude, center=center) for center in ("learn", "mean")]
    found = [fit(model, "map", num_screened=16).log_likelihood for model in models]
    torch.testing.assert_close(*found)
    assert models[0].terms[0].basis.center.item() == 0.0
    assert models[0].terms[0].basis.center.requires_grad
    model = CKA(*XY, physics=crude, center="learn").eval()
    Z = uniform(4, 2).requires_grad_()
    model.posterior(Z).mean.sum().backward()
    assert Z.grad is not None
    assert model.terms[0].basis.center.grad is None
    Z = Z.detach()
    for found in (model.predict(Z).mean, model.posterior(Z).mean, model.delta(Z).mean):
        assert not found.requires_grad


@pytest.mark.parametrize("cls", [CKA, RRA])
def test_functions_have_the_posteriors_mean_near_and_far(XY, cls):
    X, Y = XY
    model = move(cls(X, Y, physics=crude), -7.0)
    Z = torch.cat([X[:2] + 0.1, 50 + X[:2]])
    posterior = model.posterior(Z)
    values = model.sample_functions(2000, seed=0)(Z)
    error = (values.mean(0) - posterior.mean) / posterior.variance.sqrt()
    assert error.abs().max() < 0.12
