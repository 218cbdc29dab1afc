"""Observations one after the other: the Kalman filter of an RRA, the window of exact models."""

import math
import pickle
import time
from copy import deepcopy
from resource import RUSAGE_SELF, getrusage

import numpy as np
import pytest
import torch

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, VariationalCKA, fit, load, save
from gpadjust.validation import leave_one_out
from tests.systems import holding, refused, wave


def rows(n, seed, two=False):
    generator = torch.Generator().manual_seed(seed)
    X = torch.rand(n, 1, generator=generator, dtype=torch.float64)
    Y = 2 * wave(X) + X + 0.1 * torch.randn(n, 1, generator=generator, dtype=torch.float64)
    return X, torch.cat([Y, wave(X) - X], dim=-1) if two else Y


def held(model):
    """Make a model hold three samples of its hyper-parameters."""
    return holding(model, 0.0, 0.2, 0.4)


X, Y = rows(12, 0)
NEW_X, NEW_Y = rows(9, 1)
AT = torch.linspace(-0.2, 1.2, 7, dtype=torch.float64).unsqueeze(-1)


def rra(**options):
    return RRA(X, Y, physics=wave, num_features=20, **options)


def calm(model):
    """Take errors of recent observations as predicted, so that variances are the kernels'."""
    model.local_errors.recent = 0 * model.local_errors.recent
    return model


def assert_same(one, two, tolerance=1e-8):
    for name in ("rho", "delta"):
        for moment in ("mean", "variance"):
            pair = (getattr(getattr(m, name)(AT), moment) for m in (one, two))
            torch.testing.assert_close(*pair, rtol=tolerance, atol=tolerance)
    for a, b in zip(one.interval(AT), two.interval(AT), strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)
    pair = (
        m.posterior(AT).mixture_mean if m.num_samples else m.posterior(AT).mean for m in (one, two)
    )
    torch.testing.assert_close(*pair, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("samples", [False, True])
@pytest.mark.parametrize("two", [False, True])
def test_without_forgetting_the_answer_is_that_of_all_observations_together(samples, two):
    x, y = rows(12, 0, two)
    new_x, new_y = rows(9, 1, two)
    y[3, 0] = y[3, 0] if not two else math.nan
    if two:
        new_y[2, 1] = math.nan
    model = RRA(
        x,
        y,
        physics=(lambda X: wave(X).repeat(1, 2)) if two else wave,
        num_features=20,
        rho_mean="learn",
    )
    model = held(model) if samples else model.eval()
    all_at_once = model.condition_on_observations(new_x, new_y)
    model.update(new_x[:4], new_y[:4])
    for i in range(4, 9):
        model.update(new_x[i : i + 1], new_y[i : i + 1])
    assert_same(model, all_at_once)
    assert len(model.train_targets.movedim(-1, 0)) == 12


def test_with_forgetting_it_is_a_regression_whose_noise_grows_with_age():
    model, tau = rra().eval(), 5
    conditioning, scale = model.conditioning(), model.units()[1].item()
    f = [model.at(model.model_inputs(x)) for x in (X, NEW_X)]
    design = np.vstack([each.features(conditioning.features).detach().numpy() for each in f])
    means = np.hstack([each.mean().detach().numpy() for each in f])
    residual = torch.cat([Y, NEW_Y]).squeeze(-1).numpy() / scale - means
    age = np.hstack([np.full(12, 9), np.arange(8, -1, -1)])  # the model's own are of one time
    weight = np.exp(-age / tau) / model.likelihood.noise.item()
    covariance = np.linalg.inv(np.eye(40) + design.T @ (weight[:, None] * design))
    mean = covariance @ (design.T @ (weight * residual))
    model.update(NEW_X[:3], NEW_Y[:3], forget=tau)
    for i in range(3, 9):
        model.update(NEW_X[i : i + 1], NEW_Y[i : i + 1], forget=tau)
    found, sd = model.weights(), model._prior_sd().numpy()
    np.testing.assert_allclose(found.mean.numpy(), sd * mean, atol=1e-9)
    want = sd[:, None] * covariance * sd
    np.testing.assert_allclose(found.covariance_matrix.numpy(), want, atol=1e-9)


@pytest.mark.parametrize("model_class", [CKA, PhysicsMeanGP])
@pytest.mark.parametrize("samples", [False, True])
def test_an_exact_model_keeps_a_window(model_class, samples):
    model = model_class(X, Y, physics=wave)
    model = held(model) if samples else model.eval()
    # The same hyper-parameters and units, of the rows of the window alone.
    grown = model.condition_on_observations(NEW_X, NEW_Y)
    want = deepcopy(grown)
    want.train_inputs = (grown.train_inputs[0][..., -10:, :],)
    want._original_train_inputs = grown._original_train_inputs[..., -10:, :]
    want.train_targets, want.prediction_strategy = grown.train_targets[..., -10:], None
    for i in range(9):
        model.update(NEW_X[i : i + 1], NEW_Y[i : i + 1], forget=10)
    pair = zip(calm(model).predict(AT), want.predict(AT), strict=True)
    for one, two in pair:
        torch.testing.assert_close(one, two)
    assert model.train_targets.shape[-1] == 10
    assert torch.equal(model.data()["train_X"][-9:], NEW_X)


def test_known_noise_follows_the_window_and_the_filter():
    with pytest.raises(ValueError, match="pass `noise`"):
        CKA(X, Y, 0.01, physics=wave).update(NEW_X, NEW_Y, forget=15)
    noise = torch.linspace(0.01, 1, 9, dtype=torch.float64).unsqueeze(-1)
    both = torch.cat([X, NEW_X]), torch.cat([Y, NEW_Y]), torch.cat([0 * Y + 0.01, noise])
    for build in (CKA, lambda *a, **o: RRA(*a, num_features=20, **o)):
        model = build(X, Y, 0.01, physics=wave, outcome_transform=None).eval()
        all_of_them = build(*both, physics=wave, outcome_transform=None).eval()
        all_of_them.load_state_dict(
            {n: v for n, v in model.state_dict().items() if "likelihood" not in n}, strict=False
        )
        model.update(NEW_X, NEW_Y, noise, **({"forget": 21} if build is CKA else {}))
        torch.testing.assert_close(model.predict(AT).mean, all_of_them.predict(AT).mean)


@pytest.mark.slow
@pytest.mark.parametrize("build", [rra, lambda: CKA(X, Y, physics=wave)])
def test_the_whole_house(build, tmp_path):
    model = build()
    fit(model, num_draws=64, num_samples=4)
    before = model.predict(AT).mean
    functions = model.sample_functions(8, seed=0)
    was = functions(AT)
    model.update(NEW_X, NEW_Y, forget=15)
    assert not torch.equal(model.predict(AT).mean, before)
    assert torch.equal(functions(AT), was)  # drawn before
    assert_same(model, pickle.loads(pickle.dumps(model)), 1e-12)
    assert_same(model, deepcopy(model), 1e-12)
    save(model, tmp_path / "model.pt")
    assert_same(model, load(tmp_path / "model.pt", trusted=True), 1e-9)
    wider = deepcopy(model)
    wider.local_errors.recent = 0 * model.local_errors.recent + 30.0 * torch.tensor([2.0, 1.0])
    ratio = wider.predict(AT).variance / calm(deepcopy(model)).predict(AT).variance
    assert ((ratio > 1.5) & (ratio < 2)).all()
    drawn = model.sample_functions(400, seed=0)(AT)
    sd = model.predict(AT).variance.sqrt()
    assert ((drawn.mean(0) - model.predict(AT).mean).abs() < 0.4 * sd + 1e-3).all()
    more = model.condition_on_observations(*rows(3, 2))
    again = deepcopy(model)
    again.update(*rows(3, 2), forget=10**9)
    assert_same(calm(more), calm(again), 1e-5)
    assert "noise" in model.summary()
    if isinstance(model, RRA):
        kept = model.predict(AT).mean
        refused(RuntimeError, "does not keep", leave_one_out, model)
        refused(RuntimeError, "build a model of the observations", fit, model)
        assert torch.equal(model.predict(AT).mean, kept)
    else:
        leave_one_out(model)
        fit(model, "map")


def test_variances_follow_errors_and_return_to_the_prior():
    model = rra().eval()
    predicted = model.predict(NEW_X, observation_noise=True)
    squares = ((NEW_Y - predicted.mean).square() / predicted.variance).squeeze(-1)
    model.update(NEW_X, NEW_Y, forget=5)
    weights = torch.exp(torch.arange(8, -1, -1) / -5.0).double()
    want = torch.stack([(weights * squares).sum(), weights.sum()])
    torch.testing.assert_close(model.local_errors.recent, want)
    model, point = rra().eval(), torch.full((1, 1), 0.5, dtype=torch.float64)
    prior = model.terms[0].kernel.outputscale.item()
    assert model.rho(AT[:1]).variance.item() < 0.9 * prior
    model.update(point.expand(2000, 1), wave(point).expand(2000, 1), forget=10)
    np.testing.assert_allclose(model.rho(AT[:1]).variance.item(), prior, rtol=0.1)
    assert model.rho(AT[:1]).variance.item() <= prior * (1 + 1e-9)
    np.testing.assert_allclose(model.rho(AT[:1]).mean.item(), 1, atol=0.1)
    # What is observed is known to within the noise.
    assert (model.predict(point).mean - wave(point)).abs().item() < 0.1


@pytest.mark.parametrize("more", [False, True])
def test_a_subset_of_outputs_is_updated_alike(more):
    x, y = rows(12, 0, two=True)
    model = RRA(x, y, physics=lambda X: wave(X).repeat(1, 2), num_features=10).eval()
    new_x, new_y = rows(5, 1, two=True)
    model.update(new_x, new_y, forget=50)
    subset = model.subset_output([1])
    if more:
        model.update(new_x, new_y, forget=50)
        subset.update(new_x, new_y[:, 1:], forget=50)
    torch.testing.assert_close(subset.predict(AT).mean, model.predict(AT).mean[:, 1:])


def test_what_cannot_be_updated_says_so():
    model = CKA(X, Y, physics=wave)
    refused(ValueError, "pass forget=200", model.update, NEW_X, NEW_Y)
    refused(TypeError, "forget", model.update, NEW_X, NEW_Y, forget=0.5)
    refused(ValueError, "at least 1", model.update, NEW_X, NEW_Y, forget=0)
    refused(ValueError, "k x d", model.update, NEW_X.expand(2, 9, 1), NEW_Y, forget=5)
    refused(ValueError, "learns its noise", model.update, NEW_X, NEW_Y, NEW_Y.abs(), forget=5)
    ar1 = AR1(X, Y, physics=wave, bounds=[[0.0], [1.0]])
    refused(NotImplementedError, "rows of its own", ar1.update, NEW_X, NEW_Y, forget=5)
    sparse = VariationalCKA(X, Y, physics=wave, num_inducing=4)
    refused(NotImplementedError, "in place", sparse.update, NEW_X, NEW_Y)


# Time and memory of many updates do not grow


@pytest.mark.slow
def test_a_hundred_thousand_updates_take_no_more_time_or_memory_at_the_end():
    X = torch.linspace(0, 1, 20, dtype=torch.float64).unsqueeze(-1)
    model = RRA(X, 2 * wave(X) + X, physics=wave, num_features=20).eval()

    def thousand(start):
        begin = time.process_time()
        for i in range(start, start + 1000):
            x = X[i % 20 : i % 20 + 1]
            model.update(x, (2 + i / 1e5) * wave(x) + x, forget=500)
        model.predict(X)
        return time.process_time() - begin

    thousand(0)
    first = min(thousand(1000 * k) for k in range(1, 4))
    before = getrusage(RUSAGE_SELF).ru_maxrss
    for k in range(4, 97):
        thousand(1000 * k)
    assert getrusage(RUSAGE_SELF).ru_maxrss - before < 20_000  # KiB: 0.2 KiB an update
    assert min(thousand(1000 * k) for k in range(97, 100)) < 1.3 * first
    assert model.train_targets.shape[-1] == 20
    assert (model.predict(X).mean - 3 * wave(X) - X).abs().max() < 0.1
