"""Observations one after the other: the Kalman filter of an RRA, the window of exact models."""

import math
from copy import deepcopy

import pytest
import torch

from gpadjust.core import CKA, RRA, PhysicsMeanGP
from gpadjust.kinds.links import LinkedCKA
from gpadjust.kinds.updates import Kalman, Window, design
from tests.systems import drawn, line, normal, refused, same, uniform, wave, waves

AT = line(7, -0.2, 1.2)


def rows(n, seed, two=False):
    X = uniform(n, 1, seed=seed)
    Y = 2 * wave(X) + X + 0.1 * normal(n, 1, seed=seed)
    return X, torch.cat([Y, wave(X) - X], -1) if two else Y


X, Y = rows(12, 0)
NEW_X, NEW_Y = rows(9, 1)


def rra(x=X, y=Y, *known, **options):
    physics = waves if y.shape[-1] == 2 else wave
    return drawn(RRA(x, y, *known, physics=physics, num_features=20, **options), 3)


def calm(model):
    """The same model as if errors of what came were as predicted."""
    new = deepcopy(model)
    new.recent = torch.zeros_like(model.recent)
    return new


def agree(one, two, tolerance=1e-8):
    close = {"rtol": tolerance, "atol": tolerance}
    for name in ("rho", "delta"):
        torch.testing.assert_close(*(m.term(name, AT).variance for m in (one.model, two)), **close)
    for noise in (False, True):
        same(one.predict(AT, noise), two.predict(AT, noise), **close)
    pair = (m.posterior(AT).distribution.covariance_matrix for m in (one, two))
    torch.testing.assert_close(*pair, **close)


@pytest.mark.parametrize("two", [False, True])
def test_without_forgetting_a_filter_is_the_posterior_of_all_observations(two):
    (x, y), (new_x, new_y) = rows(12, 0, two), rows(9, 1, two)
    new_y[2, -1] = math.nan
    y[3, 0] = math.nan if two else y[3, 0]
    model = rra(x, y)
    kalman = Kalman(model).update(new_x[:4], new_y[:4])
    for i in range(4, 9):
        kalman.update(new_x[i : i + 1], new_y[i : i + 1])
    everything = model.condition_on_observations(new_x, new_y)
    agree(calm(kalman), everything)
    assert not torch.equal(model.predict(AT).mean, kalman.predict(AT).mean)


def test_with_forgetting_it_is_a_regression_whose_noise_grows_with_age():
    model, tau = rra(), 5
    everything = model.condition_on_observations(NEW_X, NEW_Y).conditioning()
    phi = design(everything.train)
    age = torch.cat([torch.full((12,), 9.0), torch.arange(8.0, -1, -1)]).double()
    weight = (-age / tau).exp() / everything.noise
    precision = torch.eye(phi.shape[-1]) + phi.mT @ (weight.unsqueeze(-1) * phi)
    residual = (everything.targets - everything.train.mean) * weight
    mean = torch.linalg.solve(precision, (phi.mT @ residual.unsqueeze(-1)).squeeze(-1))
    kalman = Kalman(model, forget=tau).update(NEW_X[:3], NEW_Y[:3])
    for i in range(3, 9):
        kalman.update(NEW_X[i : i + 1], NEW_Y[i : i + 1])
    torch.testing.assert_close(kalman.weights.mean, mean, rtol=1e-7, atol=1e-7)
    found = kalman.weights.root @ kalman.weights.root.mT
    torch.testing.assert_close(found, torch.linalg.inv(precision), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("build", [CKA, PhysicsMeanGP])
def test_a_window_is_the_model_of_its_last_rows(build):
    model = drawn(build(X, Y, physics=wave), 3)
    window = Window(model, 10)
    for i in range(9):
        window.update(NEW_X[i : i + 1], NEW_Y[i : i + 1])
    assert torch.equal(window.data.X, torch.cat([X[-1:], NEW_X]))
    everything = model.condition_on_observations(NEW_X, NEW_Y)
    last = everything.subset_rows(torch.arange(11, 21))
    same(calm(window).predict(AT), last.predict(AT))
    assert window.model.left_out().means.shape[-2] == 10


@pytest.mark.parametrize("kind", [lambda model: Window(model, 21), Kalman])
def test_known_variances_and_missing_outputs_follow(kind):
    noise, model = line(9, 0.01, 1.0), rra(X, Y, 0.01)
    given = model.condition_on_observations(NEW_X, NEW_Y, noise)
    updated = kind(model)
    refused(ValueError, "variances", updated.update, NEW_X, NEW_Y, -noise)
    updated.update(NEW_X, NEW_Y, noise)
    before = calm(updated).predict(AT).mean
    torch.testing.assert_close(before, given.predict(AT).mean)
    updated.update(NEW_X[:1], torch.full_like(NEW_Y[:1], math.nan), noise[:1])
    if isinstance(updated, Kalman):
        torch.testing.assert_close(updated.predict(AT).mean, before)


def test_variances_follow_recent_errors():
    for updated in (Kalman(rra(), forget=5), Window(rra(), 5)):
        predicted = rra().predict(NEW_X, observation_noise=True)  # nothing was asked of it
        squares = ((NEW_Y - predicted.mean).square() / predicted.variance).squeeze(-1)
        updated.update(NEW_X, NEW_Y)
        left = (torch.arange(8, -1, -1) / -5.0).exp().double()
        expected = torch.stack([(left * squares).sum(), left.sum()])
        torch.testing.assert_close(updated.recent[0], expected)
    for noise in (False, True):
        plain = calm(updated).marginals(AT, noise).variances
        wider = deepcopy(updated)
        wider.recent = torch.tensor([[50.0, 10.0]]).double()
        torch.testing.assert_close(wider.marginals(AT, noise).variances, 3 * plain)
    assert torch.equal(wider.marginals(AT).means, calm(updated).marginals(AT).means)


def test_another_device_has_weights_and_errors_too():
    kalman = Kalman(rra()).update(NEW_X, NEW_Y)
    before = kalman.predict(AT)
    for moved in (kalman.to("cpu"), kalman.model.to("cpu") and kalman):
        same(moved.predict(AT), before)
    assert kalman.to("meta").data.X.is_meta
    assert kalman.recent.is_meta


def test_nothing_changes_by_bad_targets_of_a_link():
    positive = Window(LinkedCKA(X, Y.exp(), physics=lambda X: wave(X).exp(), link="log"), 12)
    before = positive.predict(AT).mean
    refused(ValueError, "above 0", positive.update, NEW_X, -NEW_Y.exp())
    assert torch.equal(positive.predict(AT).mean, before)
    assert (positive.update(NEW_X, NEW_Y.exp()).predict(AT).mean > 0).all()


REFUSED = [
    (lambda: Kalman(CKA(X, Y, physics=wave)), TypeError, "Window"),
    (lambda: Kalman(rra(), forget=0), ValueError, "forget"),
    (lambda: Window(rra(), 1), ValueError, "size"),
    (lambda: Window(rra(), 5).update(NEW_X.expand(2, 9, 1), NEW_Y), ValueError, "k x d"),
    (lambda: Window(rra(), 5).update(NEW_X, NEW_Y.expand(2, 9, 1)), ValueError, "k x m"),
    (lambda: Kalman(rra()).sample_functions(3), NotImplementedError, "rsample"),
]


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_bad_input(call, error, words):
    refused(error, words, call)
