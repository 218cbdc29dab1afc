"""Unknown constant means of rho and delta: universal kriging, after a fit."""

import copy
import statistics

import pytest
import torch

from gpadjust import CKA, RRA, PhysicsMeanGP, ScaleGP, fit

QUICK = {"num_screened": 16, "num_starts": 2}
MEANS = [("rho",), ("delta",), ("rho", "delta")]


def crude(X):
    return torch.stack([2 + (3 * X[..., 0]).sin() + X[..., 1], 1 + (4 * X[..., 1]).cos()], dim=-1)


def first(X):
    return crude(X)[..., :1]


def problem(uniform, m=1):
    X = uniform(10, 2)
    noise = 0.05 * torch.randn(10, m, dtype=torch.float64)
    return X, 3 * crude(X)[..., :m] + 2 + X[..., :1].square() + noise


def fitted(X, Y, means=("rho", "delta"), center=0.0):
    physics = crude if Y.shape[-1] == 2 else first
    learnt = {f"{name}_mean": "learn" for name in means}
    model = CKA(X, Y, physics=physics, center=center, **learnt)
    fit(model, "map", **QUICK)
    return model


@pytest.mark.parametrize("means", MEANS, ids="+".join)
@pytest.mark.parametrize("center", [0.0, "mean"])
@pytest.mark.parametrize("m", [1, 2])
def test_posteriors_are_those_of_universal_kriging(uniform, dense, means, center, m):
    """The limit of vague priors (Rasmussen and Williams 2006, sec. 2.7)."""
    X, Y = problem(uniform, m)
    model = fitted(X, Y, means, center)
    Z = uniform(6, 2, low=-0.5, high=1.5, seed=3)
    for j in range(m):
        vague = {"means": [1.0, 0.0], "vague": 1e6}
        formula = dense(model, X, Y, lambda X: crude(X)[:, :m], output=j, center=center, **vague)
        for quantity in ("posterior", "rho", "delta"):
            mean, covariance = getattr(formula, quantity)(Z)
            posterior, variance = getattr(model, quantity)(Z), covariance.diagonal()
            size = mean.abs().max().item()
            torch.testing.assert_close(posterior.mean[:, j], mean, rtol=1e-5, atol=1e-5 * size)
            torch.testing.assert_close(
                posterior.variance[:, j], variance, rtol=1e-3, atol=1e-5 * variance.max()
            )
        assert model.predict(Z).mean[:, j].tolist() == pytest.approx(
            formula.posterior(Z)[0].tolist(), rel=1e-5
        )


@pytest.mark.parametrize("factor", [8.0, 1e6, 1e-6, -2.0])
def test_a_constant_factor_is_recovered(uniform, factor):
    X, Z = uniform(12, 1), uniform(20, 1, low=-0.5, high=1.5, seed=1)

    def physics(X):
        return 2 + (5 * X).sin()

    model = PhysicsMeanGP(X, factor * physics(X), physics=physics, rho_mean="learn")
    fit(model, "map", **QUICK)
    assert model.term_mean("rho") == pytest.approx(factor, rel=1e-6)
    torch.testing.assert_close(model.rho(Z).mean, torch.full_like(Z, factor), rtol=1e-6, atol=0)
    torch.testing.assert_close(
        model.posterior(Z).mean.detach(), factor * physics(Z), rtol=1e-5, atol=1e-5 * abs(factor)
    )


@pytest.mark.parametrize("means", MEANS, ids="+".join)
@pytest.mark.parametrize("center", [0.0, "mean"])
def test_far_from_the_data_the_constants_remain(uniform, means, center):
    X, Y = problem(uniform)
    model = fitted(X, Y, means, center)
    with torch.no_grad():
        for term in model.terms:
            term.kernel.base_kernel.raw_lengthscale.fill_(-3.0).requires_grad_(False)
    fit(model.train(), "map", num_screened=0, num_starts=1)  # the constants at these lengthscales
    Z = torch.full((1, 2), 30.0, dtype=torch.float64)
    rho, delta = (model.term_mean(name) for name in ("rho", "delta"))
    mean = model.eval().posterior(Z).mean
    torch.testing.assert_close(mean, rho * crude(Z)[..., :1] + delta, rtol=1e-3, atol=1e-3)
    assert ("rho" in means) != (rho == 1.0)
    known = 0.0 if center == 0.0 else (1 - rho) * crude(X)[..., 0].mean().item()
    assert ("delta" in means) != (delta == pytest.approx(known, abs=1e-9))


def test_given_means(uniform):
    X, Y = problem(uniform, 2)
    model = CKA(X, Y, physics=crude, rho_mean=2.5, delta_mean=-7.0, center="mean")
    Z = torch.full((1, 2), 300.0, dtype=torch.float64)
    for j in range(2):
        assert model.term_mean("rho", j) == pytest.approx(2.5)
        assert model.term_mean("delta", j) == pytest.approx(-7.0)
    torch.testing.assert_close(model.posterior(Z).mean, 2.5 * crude(Z) - 7.0)
    torch.testing.assert_close(model.delta(Z).mean, torch.full_like(Z, -7.0))
    assert not any(term.learns_mean for term in model.terms)


@pytest.mark.parametrize(("cls", "m"), [(CKA, 1), (CKA, 2), (ScaleGP, 1), (RRA, 2)])
def test_conditioning_and_copies(uniform, same, cls, m):
    X, Y = problem(uniform, m)
    Z, new_X, new_Y = uniform(6, 2, seed=3), uniform(2, 2, seed=4), Y[:2]
    means = ("rho_mean",) if cls is ScaleGP else ("rho_mean", "delta_mean")
    options = {"physics": crude if m == 2 else first, **dict.fromkeys(means, "learn")}
    model = cls(X, Y, **options)
    fit(model, "map", **QUICK)
    with torch.no_grad():
        model.likelihood.noise_covar.raw_noise.fill_(-7.0)
    rebuilt = cls(torch.cat([X, new_X]), torch.cat([Y, new_Y]), **options)
    rebuilt.load_state_dict(model.state_dict())
    same(model.condition_on_observations(new_X, new_Y), rebuilt.eval(), Z, 1e-5)
    same(copy.deepcopy(model), model, Z, 1e-12)
    if m > 1:
        for outputs in ([0], [1, 0]):
            same(model.subset_output(outputs), model, Z, 1e-9, outputs)


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "limit"), [(4.0, 0.01), (1.0, 0.003)], ids=["A", "B"])
def test_error_on_forresters_pair(forrester, factor, limit):
    """Reading A: f_true = 8 f_p - 20 x; reading B: f_true = 2 f_p - 5 x."""
    errors, Z = [], forrester.test_X
    for seed in range(10):
        X, Y = forrester.data(seed)
        means = {"rho_mean": "learn", "delta_mean": "learn"}
        model = CKA(X, Y * factor, physics=forrester.crude, center="mean", **means)
        fit(model, "map")
        off = model.posterior(Z).mean - factor * forrester.truth(Z)
        errors.append(off.square().mean().sqrt().item())
    assert statistics.mean(errors) <= limit


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6, 1e8])
def test_a_constant_of_both_makes_no_difference(uniform, offset):
    X, Y = problem(uniform)
    means = {"rho_mean": "learn", "delta_mean": "learn"}
    model = PhysicsMeanGP(X, Y + offset, physics=lambda X: first(X) + offset, **means)
    fit(model, "map", **QUICK)
    assert model.term_mean("rho") == pytest.approx(3.0, abs=0.4)
