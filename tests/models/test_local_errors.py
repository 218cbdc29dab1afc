"""Variances near what was missed when it was left out."""

import pytest
import torch
from torch import Size

from gpadjust import CKA, RRA, fit, load, save
from gpadjust.models.local_errors import LocalErrors
from tests.systems import line, uniform

KINK = 0.6


def truth(X):
    """Two outputs: one with a kink and another without."""
    kinked = 2 * X[:, :1].sin() + 3 * (X[:, :1] - KINK).clamp_min(0.0) * (1 + X[:, 1:])
    return torch.cat([kinked, 2 * X[:, :1].sin() + X[:, 1:].square()], dim=-1)


def physics(X):
    return X[..., :1].sin().expand(*X.shape[:-1], 2)


@pytest.fixture(scope="module")
def fitted():
    X = uniform(60, 2, seed=4)
    model = CKA(X, truth(X), physics=physics)
    fit(model, num_draws=256)
    return model


@pytest.fixture(scope="module")
def Z():
    return uniform(400, 2, seed=5)


def without(model):
    """The same model, whose variances are those of its kernels."""
    other = model.subset_output([0, 1])
    other.local_errors.forget()
    return other


def test_the_formula():
    errors = LocalErrors(Size([2]), 1)
    x = torch.tensor([[0.0], [0.5], [100.0]], dtype=torch.float64)
    torch.testing.assert_close(errors(x), torch.ones(2, 3, dtype=torch.float64))
    squares = torch.tensor([[9.0, 0.0], [0.2, 0.3]], dtype=torch.float64)
    points = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    errors.learn(squares, points, torch.full((2, 1, 1), 0.5, dtype=torch.float64))
    near = (-0.5 * ((x - points.mT) / 0.5).square()).exp()
    first = ((1 + 9 * near[:, 0]) / (1 + near.sum(-1))).clamp_min(1.0)
    torch.testing.assert_close(errors(x), torch.stack([first, torch.ones_like(first)]))
    assert first[0] > 4
    assert first[2] == 1


@pytest.mark.slow
def test_intervals_hold_at_a_kink_and_no_others_are_wider(fitted, Z):
    Y, plain = truth(Z), without(fitted)
    held, width = {}, {}
    for name, model in (("own", fitted), ("plain", plain)):
        low, high = model.interval(Z, observation_noise=True)
        held[name], width[name] = (low <= Y) & (high >= Y), high - low
    near = (Z[:, 0] - KINK).abs() < 0.1
    assert held["own"][near, 0].double().mean() > held["plain"][near, 0].double().mean() + 0.1
    assert held["own"][:, 0].double().mean() > 0.9
    wider = width["own"] / width["plain"]
    assert wider[near, 0].mean() > 1.3
    assert wider[:, 1].mean() < 1.05


def test_predictions_posteriors_gradients_and_given_noise_agree(fitted, Z):
    X = Z[:40]
    mean, variance = fitted.predict(X)
    assert (variance / without(fitted).predict(X).variance).max() > 1.5
    posterior = fitted.posterior(X)
    torch.testing.assert_close(posterior.mixture_mean, mean)
    torch.testing.assert_close(posterior.mixture_variance, variance)
    noisy = fitted.posterior(X, observation_noise=True).mixture_variance
    torch.testing.assert_close(noisy, fitted.predict(X, observation_noise=True).variance)
    torch.testing.assert_close(posterior.covariance_matrix, covariance(fitted, X))
    X = Z[:3].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda X: fitted.predict(X).variance, X, rtol=1e-3)
    given = torch.full((3, 2), 0.5, dtype=torch.float64)
    more = fitted.predict(Z[:3], given).variance - fitted.predict(Z[:3]).variance
    torch.testing.assert_close(more, given)


def test_functions_are_as_much_farther_from_their_mean(fitted, Z):
    """Of each sample one function: what it is without, and its mean, say where it is."""
    wider = fitted.widening(fitted.model_inputs(Z))[0, 0].sqrt()
    at = wider.argmax()
    X, times = Z[at].unsqueeze(0), wider[at]
    own, plain = (
        model.sample_functions(fitted.num_samples, seed=0, num_features=16)(X)[:, 0, 0]
        for model in (fitted, without(fitted))
    )
    means = fitted.components(X, False)[0][:, 0, 0]
    found = plain - (own - plain) / (times - 1)
    torch.testing.assert_close(found.sort().values, means.sort().values)


def covariance(model, X):
    """The kernels' covariance with both sides multiplied, ``S x (m q) x (m q)``."""
    root = model.widening(model.model_inputs(X)).sqrt().flatten(-2)  # 1 x (m q)
    plain = without(model).posterior(X).covariance_matrix
    return plain * root.unsqueeze(-1) * root.unsqueeze(-2)


def test_what_models_do_with_them(fitted, Z, tmp_path, monkeypatch):
    one = fitted.subset_output([1])
    torch.testing.assert_close(one.predict(Z).variance, fitted.predict(Z).variance[:, 1:])
    model = CKA(*[fitted.data()[name] for name in ("train_X", "train_Y")], physics=physics)
    model.load_state_dict(fitted.state_dict())
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", trusted=True)
    torch.testing.assert_close(again.predict(Z), fitted.predict(Z))
    more = fitted.condition_on_observations(Z[:2], truth(Z[:2]))
    wider = more.widening(more.model_inputs(Z))
    torch.testing.assert_close(wider, fitted.widening(fitted.model_inputs(Z)))
    again.release_samples()
    assert again.larger_errors is None
    model = fitted.subset_output([0, 1])
    monkeypatch.setattr("gpadjust.inference.bayes.default_num_samples", lambda n: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        fit(model, num_draws=16)
    torch.testing.assert_close(model.predict(Z), fitted.predict(Z))


def test_who_has_none():
    """A point fit, whose intervals are too narrow anyway, and kernels without lengthscales."""
    X = line(8)
    Y = (X - 0.5).abs()
    point = CKA(X, Y, physics=torch.zeros_like)
    fit(point, "map", num_starts=1, num_screened=8)
    features = RRA(X, Y, physics=torch.zeros_like, num_features=8)
    fit(features, num_draws=16)
    assert point.larger_errors is None
    assert features.larger_errors is None
