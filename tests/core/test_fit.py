"""Draws, evidence and probabilities against numerical integrals, and what a fit promises."""

import math
import warnings

import pytest
import torch

from gpadjust import core
from gpadjust.core import CKA, GP, Choice, LogNormal, SamplingWarning, Term, ZeroMeanGP, fit
from gpadjust.core.fitting import modes
from gpadjust.core.sample import around_mode
from gpadjust.physics import FunctionPhysics, Unknown
from tests import systems
from tests.systems import wave


def noisy(n, seed=0, noise=0.05):
    generator = torch.Generator().manual_seed(seed)
    options = {"generator": generator, "dtype": torch.float64}
    return torch.rand(n, 2, **options), noise * torch.randn(n, 1, **options)


def integral(model):
    """The log evidence and the moments of the only coordinate, by a fine grid."""
    u = torch.linspace(-8, 8, 4001, dtype=torch.float64)
    at = u.reshape(-1, 1, 1)
    logs = model.log_likelihood(at, False)[0].flatten() - 0.5 * u.square()
    logs = logs - 0.5 * torch.log(torch.tensor(2 * torch.pi, dtype=torch.float64))
    weights = logs.softmax(0)
    mean = (weights * u).sum()
    sd = (weights * (u - mean).square()).sum().sqrt()
    units = len(model.data.Y) * model.unit.log().sum()
    return logs.logsumexp(0) + (u[1] - u[0]).log() - units, mean, sd


@pytest.mark.parametrize("n", [5, 20, 60, pytest.param(200, marks=pytest.mark.slow)])
def test_evidence_and_draws(n):
    """Of noise alone, with its variance as the only unknown number."""
    X, Y = noisy(n)
    noise = core.Noise(priors=[LogNormal(1e-3, 55.0)])
    model = GP(X, Y, terms=[Term("f")], noise=noise)
    assert model.table.size == 1
    expected, mean, sd = integral(model)
    result = fit(model, num_draws=256)
    assert result.log_evidence.item() == pytest.approx(expected.item(), abs=0.15)
    draws = model.draws.flatten()
    assert draws.mean().item() == pytest.approx(mean.item(), abs=0.3 * sd.item())
    assert draws.std().item() == pytest.approx(sd.item(), rel=0.25)
    fit(model, "map")
    grid = torch.linspace(-3, 3, 601, dtype=torch.float64)
    values, _ = model.log_likelihood(grid[:, None, None])
    best = grid[(values.flatten() - 0.5 * grid.square()).argmax()]
    assert model.u.item() == pytest.approx(best.item(), abs=0.02)


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_a_point_fit_finds_a_narrow_mode(seed):
    """The truth is 8 f_p - 20 x without noise: few starts lead to it, as far as they are."""

    def truth(X):
        return (6 * X - 2).square() * (12 * X - 4).sin() / 4

    X = systems.uniform(8, 1, low=-0.6, seed=seed)
    model = CKA(X, truth(X), physics=lambda X: truth(X) / 8 + 2.5 * X, center=0.0, constants=False)
    fit(model, "map")
    line = systems.line(40, -0.6)
    with torch.no_grad():
        error = (model.posterior(line).mean - truth(line)).square().mean().sqrt()
    assert error < 0.01


def test_a_point_fit_seeks_modes_by_few_rows_first(monkeypatch):
    """It is as likely as by all rows from the beginning, and asks less often for their density."""
    X, noise = noisy(210, noise=0.02)
    model = CKA(X, 2 * wave(X) + X[:, :1] + noise, physics=wave)
    rows, density = [], GP.log_likelihood

    def counted(model, u, *args, **options):
        rows.append(len(u) * len(model.data.Y) ** 3)
        return density(model, u, *args, **options)

    monkeypatch.setattr(GP, "log_likelihood", counted)
    found = modes(model, 0, seed=0, is_precise=True)
    work = sum(rows)
    fit(model, "map")
    both = torch.cat([found[:1], model.u.detach()])
    logs = density(model, both, False, choice=0)[0] - 0.5 * both.square().sum(-1)
    assert logs[1, 0] > logs[0, 0] - 1
    assert sum(rows) < 1.3 * work


@pytest.mark.parametrize("n", [8, 60])
def test_probabilities_of_nested_models(n):
    """A constant is in the targets or not: Bayes' rule by two integrals."""
    X, Y = noisy(n)
    Y = Y + 0.02
    terms = [Term("f", constant=LogNormal(0.3, 1.0))]
    choices = [Choice("some", 0.6), Choice("none", 0.4, ("f.constant",))]
    both = GP(X, Y, terms=terms, choices=choices)
    logs = []
    for k in range(2):
        u = torch.zeros(4001, 1, both.table.size, dtype=torch.float64)
        u[:, 0, 1] = torch.linspace(-8, 8, 4001)  # the noise; the constant's variance is known
        own = both.log_likelihood(both.table.with_choice(u, k), False)[0].flatten()
        logs.append((own - 0.5 * u[:, 0, 1].square()).logsumexp(0))
    shares = torch.tensor([0.6, 0.4]).double() * torch.stack(logs).softmax(0)
    expected = (shares / shares.sum())[0].item()
    result = fit(both, num_draws=256)
    assert result.probabilities["some"][0] == pytest.approx(expected, abs=0.06)
    chosen = both.table.chosen(both.table.values(both.draws)).double().mean().item()
    assert 1 - chosen == pytest.approx(result.probabilities["some"][0], abs=0.01)


@pytest.mark.parametrize("n", [12, 60])
def test_fitted_twice_is_fitted_once(n):
    X, e = noisy(n)
    model = CKA(X, 1.3 * wave(X) + X[:, 1:] + e, physics=wave)
    before = torch.random.get_rng_state()
    first = fit(model, seed=3)
    assert torch.equal(before, torch.random.get_rng_state())
    once = model.predict(X)
    fit(model, "map")
    second = fit(model, seed=3)
    assert all(map(torch.equal, once, model.predict(X)))
    assert torch.equal(first.log_evidence, second.log_evidence)
    assert not torch.equal(fit(model, seed=4).log_evidence, second.log_evidence)


def test_the_approximation_of_a_normal_posterior_is_exact():
    """But for its width, half as much again; a number that data say nothing of keeps its prior."""
    a, b = torch.tensor([[[4.0, 0.0]], [[0.7, 1.5]]], dtype=torch.float64)

    def log_likelihood(u, with_gradient=True):
        return -0.5 * (a * (u - b).square()).sum(-1), -a * (u - b)

    found, log_evidence = around_mode(log_likelihood, a * b / (1 + a))
    expected = 1.5**2 * torch.diag_embed(1 / (1 + a))
    torch.testing.assert_close(found.root @ found.root.mT, expected)
    exact = -0.5 * (a * b.square() / (1 + a) + (1 + a).log()).sum(-1)
    torch.testing.assert_close(log_evidence, exact)


def test_the_approximation_of_a_narrow_bend():
    """Its range along the bend is not that of chords across it: r = (s + d^2, d), s and d apart."""
    narrow, wide = 1e-4, 1e-1

    def log_likelihood(u, with_gradient=True):
        s, d = u.sum(-1), u[..., 0] - u[..., 1]
        by_s, by_d = (s + d.square()) / narrow**2, d / wide**2
        by_d = by_d + 2 * d * by_s
        slope = -torch.stack([by_s + by_d, by_s - by_d], -1)
        return -0.5 * ((s + d.square()) / narrow).square() - 0.5 * (d / wide).square(), slope

    found, _ = around_mode(log_likelihood, torch.zeros(1, 2).double())
    s, d = torch.tensor([[1.0, 1.0], [1.0, -1.0]]).double()
    hessian = torch.eye(2) + torch.outer(s, s) / narrow**2 + torch.outer(d, d) / wide**2
    covariance = found.root[0] @ found.root[0].mT
    torch.testing.assert_close(covariance, 1.5**2 * hessian.inverse(), rtol=1e-3, atol=0)


def test_the_approximation_of_a_peak_that_differences_pass_over():
    """(1 + (u / w)^2)^-1 is convex beyond w / sqrt(3): the first differences are."""
    w = 0.02

    def log_likelihood(u, with_gradient=True):
        return -(1 + (u / w).square()).log().sum(-1), -2 * u / (w**2 + u.square())

    found, _ = around_mode(log_likelihood, torch.zeros(1, 1).double())
    expected = 1.5**2 / (1 + 2 / w**2)
    torch.testing.assert_close(found.root.square().item(), expected, rtol=0.05, atol=0)


@pytest.mark.slow
def test_a_law_that_is_right_is_as_likely_as_its_corrections():
    """Little noise: far from the mode its likelihood is less than what the whole model has."""
    X = torch.linspace(0, 3, 20).double().unsqueeze(-1)
    unknowns = {"a": Unknown(1.0, sd=0.5), "b": Unknown(1.0, factor=1.5)}
    law = FunctionPhysics(lambda X, p: p.a * torch.exp(-p.b * X[:, 0]), unknowns=unknowns)
    noise = torch.randn(20, 1, generator=torch.Generator().manual_seed(0)).double()
    result = fit(CKA(X, 1.2 * torch.exp(-0.8 * X) + 1e-3 * noise, physics=law))
    assert result.probabilities["as it is"][0] > 0.2


@pytest.mark.slow
def test_the_error_is_how_far_seeds_are_apart():
    X, e = noisy(8)
    unknowns = {"a": Unknown(1.0, sd=0.5), "b": Unknown(0.0, sd=1.0)}
    law = FunctionPhysics(lambda X, p: p.a * wave(X)[:, 0] + p.b, unknowns=unknowns)
    model = core.PhysicsMeanGP(X, wave(X) + 0.3 + e, physics=law)
    moments, parameters, errors = [], [], []
    for seed in range(20):
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):
            result = fit(model, num_draws=16, seed=seed)
        errors.append([result.error, result.parameter_error])
        mean, variance = model.left_out()
        moments.append(torch.stack([mean.mean(0), variance.mean(0) + mean.var(0, correction=0)]))
        found = model.physics_parameters
        parameters.append(torch.stack([found.mean, found.sd]))
    mean, variance = torch.stack(moments, 1)
    moved = (mean.var(0) / variance.mean(0)).mean().sqrt()
    mean, sd = torch.stack(parameters, 1)
    moved = torch.stack([moved, (mean.var(0).sqrt() / sd.mean(0)).max()])
    ratio = torch.tensor(errors).square().mean(0).sqrt() / moved
    assert ((ratio > 0.5) & (ratio < 2)).all()
    assert f"move means of parameters by {result.parameter_error:.2f}." in str(result)
    assert math.isnan(fit(ZeroMeanGP(X, wave(X) + e), num_draws=16).parameter_error)


def test_evidence_of_targets_in_another_unit():
    """Of outputs that share an unknown number it is one, in the unit of each that is there."""
    X, e = noisy(6)
    Y = torch.cat([1.2 * wave(X) + e, 2.4 * wave(X) - e], 1)
    Y[2, 1] = torch.nan
    found, unknowns = [], {"a": Unknown(1.0, sd=0.5)}
    both = lambda X: torch.cat([wave(X), 2 * wave(X)], -1)  # noqa: E731
    for size in (1.0, 1024.0):  # without rounding
        law = lambda X, p, size=size: size * p.a.unsqueeze(-1) * both(X)  # noqa: E731
        physics = FunctionPhysics(law, unknowns=unknowns)
        model = core.PhysicsMeanGP(X, size * Y, physics=physics)
        with warnings.catch_warnings(action="ignore", category=SamplingWarning):
            found.append(fit(model, num_draws=16).log_evidence)
    assert found[0].shape == (1,)
    assert (found[0] - found[1]).item() == pytest.approx(11 * math.log(1024.0), abs=1e-6)


def test_it_shrinks_to_the_formula_or_leaves_it():
    X, e = noisy(15)
    Z, _ = noisy(200, seed=1)
    truth = 1.3 * wave(Z) + 0.4
    right = CKA(X, 1.3 * wave(X) + 0.4 + e, physics=wave)
    result = fit(right)
    assert result.probabilities["as it is up to a factor and an offset"][0] > 0.4
    A = torch.cat([wave(X), torch.ones_like(e)], 1)
    a, b = torch.linalg.lstsq(A, 1.3 * wave(X) + 0.4 + e).solution.flatten()
    least = (a * wave(Z) + b - truth).square().mean().sqrt()
    assert (right.predict(Z).mean - truth).square().mean().sqrt() < 1.6 * least
    useless = CKA(X, 3 * X[:, 1:] + X[:, :1].square() + e, physics=lambda X: (40 * X[:, :1]).cos())
    result = fit(useless)
    assert result.probabilities["of no use"][0] > 0.5
    assert "of no use 0." in str(result) or "of no use 1." in str(result)


@pytest.mark.slow
def test_seeds_agree_of_clustered_inputs_and_exact_data():
    """One called converged what another seed changed; exact smooth data always got a warning."""
    x = torch.logspace(-3, 1, 20, dtype=torch.float64)
    x = torch.cat([x, 1.001 * x[:9]]).unsqueeze(-1)
    model = ZeroMeanGP(x, x.log() + 0.3 * (3 * x.log()).sin())
    means, sds = [], []
    for seed in range(3):
        fit(model, seed=seed)
        mean, variance = model.predict(x + 0.01)
        means.append(mean)
        sds.append(variance.sqrt())
    away = torch.stack(means).std(0) / torch.stack(sds).mean(0)
    assert away.square().mean().sqrt() < 0.5
    X, _ = noisy(256)
    assert fit(ZeroMeanGP(X, (3 * X).sin().sum(-1, True))).converged


def test_the_generator_is_left_alone():
    X, e = noisy(12)
    before = torch.random.get_rng_state()
    fit(CKA(X, wave(X) + e, physics=wave))
    assert torch.equal(before, torch.random.get_rng_state())
