"""Unknown constant means of rho and delta: universal kriging, after a fit."""

import pickle
import statistics

import pytest
import torch

from gpadjust import CKA, PhysicsMeanGP, fit
from gpadjust.inference.objective import Objective

QUICK = {"num_screened": 16, "num_starts": 2}
MEANS = [("rho",), ("delta",), ("rho", "delta")]


def crude(X):
    return torch.stack([2 + (3 * X[..., 0]).sin() + X[..., 1], 1 + (4 * X[..., 1]).cos()], dim=-1)


def problem(uniform, m=1):
    X = uniform(10, 2)
    noise = 0.05 * torch.randn(10, m, dtype=torch.float64)
    return X, 3 * crude(X)[..., :m] + 2 + X[..., :1].square() + noise


def fitted(X, Y, means=("rho", "delta"), center=0.0, **options):
    m = Y.shape[-1]
    model = CKA(
        X,
        Y,
        physics=lambda X: crude(X)[..., :m],
        center=center,
        **{f"learn_{name}_mean": True for name in means},
        **options,
    )
    fit(model, **QUICK)
    return model


class UniversalKriging:
    """Dense formulas (Rasmussen and Williams 2006, sec. 2.7) for one output, in the user's units.

    With the columns h of f_p - c and 1 that are unknown, and g what they are for the quantity.
    """

    def __init__(self, model, j, X, y, means, center, rbf):
        pick = (lambda t: t.detach()[j]) if model.num_outputs > 1 else (lambda t: t.detach())
        scale = model.outcome_transform.stdvs.reshape(-1)[j]
        rho, delta = model.rho_covar_module, model.delta_covar_module
        self.k_rho = rbf(pick(rho.base_kernel.lengthscale), pick(rho.outputscale))
        self.k_delta = rbf(pick(delta.base_kernel.lengthscale), pick(delta.outputscale) * scale**2)
        noise = pick(model.likelihood.noise) * scale**2
        self.X, self.j, self.means = X, j, means
        self.c = self.physics(X).mean() if center == "mean" else center
        f = self.physics(X) - self.c
        K = f[:, None] * self.k_rho(X, X) * f + self.k_delta(X, X)
        self.inverse = torch.linalg.inv(K + noise * torch.eye(len(X), dtype=torch.float64))
        self.H = self.columns(f, torch.ones_like(f))
        self.A = torch.linalg.inv(self.H.mT @ self.inverse @ self.H)
        residual = y - self.physics(X)
        self.beta = self.A @ self.H.mT @ self.inverse @ residual
        self.weights = self.inverse @ (residual - self.H @ self.beta)

    def physics(self, X):
        return crude(X)[:, self.j]

    def columns(self, of_rho, of_delta):
        parts = {"rho": of_rho, "delta": of_delta}
        return torch.stack([parts[name] for name in self.means], dim=-1)

    def condition(self, prior_mean, prior_variance, cross, columns):
        rest = columns - cross @ self.inverse @ self.H
        mean = prior_mean + columns @ self.beta + cross @ self.weights
        variance = prior_variance - ((cross @ self.inverse) * cross).sum(-1)
        return mean, variance + ((rest @ self.A) * rest).sum(-1)

    def posterior(self, Z):
        f, g = self.physics(self.X) - self.c, self.physics(Z) - self.c
        cross = g[:, None] * self.k_rho(Z, self.X) * f + self.k_delta(Z, self.X)
        prior = (g.square() * self.k_rho(Z, Z).diagonal()) + self.k_delta(Z, Z).diagonal()
        return self.condition(self.physics(Z), prior, cross, self.columns(g, torch.ones_like(g)))

    def rho(self, Z):
        cross = self.k_rho(Z, self.X) * (self.physics(self.X) - self.c)
        one = torch.ones(len(Z), dtype=torch.float64)
        columns = self.columns(one, 0 * one)
        return self.condition(1.0, self.k_rho(Z, Z).diagonal(), cross, columns)

    def delta(self, Z):
        cross = self.k_delta(Z, self.X) - self.c * self.k_rho(Z, self.X) * (
            self.physics(self.X) - self.c
        )
        prior = self.k_delta(Z, Z).diagonal() + self.c**2 * self.k_rho(Z, Z).diagonal()
        one = torch.ones(len(Z), dtype=torch.float64)
        return self.condition(0.0, prior, cross, self.columns(-self.c * one, one))


@pytest.mark.parametrize("means", MEANS, ids="+".join)
@pytest.mark.parametrize("center", [0.0, "mean"])
@pytest.mark.parametrize("m", [1, 2])
def test_posteriors_are_those_of_universal_kriging(uniform, rbf, means, center, m):
    X, Y = problem(uniform, m)
    model = fitted(X, Y, means, center)
    Z = uniform(6, 2, low=-0.5, high=1.5, seed=3)
    for j in range(m):
        expected = UniversalKriging(model, j, X, Y[:, j], means, center, rbf)
        for quantity in ("posterior", "rho", "delta"):
            mean, variance = getattr(expected, quantity)(Z)
            posterior = getattr(model, quantity)(Z)
            size = mean.abs().max().item()
            torch.testing.assert_close(
                posterior.mean[:, j].detach(), mean, rtol=1e-6, atol=1e-6 * size
            )
            torch.testing.assert_close(
                posterior.variance[:, j].detach(), variance, rtol=1e-3, atol=1e-6 * variance.max()
            )
        predicted = model.predict(Z)
        torch.testing.assert_close(predicted.mean[:, j].detach(), expected.posterior(Z)[0])


@pytest.mark.parametrize("factor", [8.0, 1e6, 1e-6, -2.0])
def test_a_constant_factor_is_recovered(uniform, factor):
    X, Z = uniform(12, 1), uniform(20, 1, low=-0.5, high=1.5, seed=1)

    def physics(X):
        return 2 + (5 * X).sin()

    model = PhysicsMeanGP(X, factor * physics(X), physics=physics, learn_rho_mean=True)
    fit(model, **QUICK)
    assert model.mean_module.rho_mean.item() == pytest.approx(factor, rel=1e-6)
    torch.testing.assert_close(
        model.posterior(Z).mean.detach(), factor * physics(Z), rtol=1e-5, atol=1e-5 * abs(factor)
    )


@pytest.mark.parametrize("means", MEANS, ids="+".join)
def test_far_from_the_data_the_constants_remain(uniform, means):
    X, Y = problem(uniform)
    model = fitted(X, Y, means)
    with torch.no_grad():
        for kernel in (model.rho_covar_module, model.delta_covar_module):
            kernel.base_kernel.raw_lengthscale.fill_(-3.0)
    model.train()
    fit_constants(model)
    Z = torch.full((1, 2), 30.0, dtype=torch.float64)
    rho, delta = (model.mean_module.rho_mean, model.mean_module.delta_mean)
    scale = model.outcome_transform.stdvs
    expected = rho * crude(Z)[..., :1] + delta * scale
    torch.testing.assert_close(model.posterior(Z).mean, expected, rtol=1e-3, atol=1e-3)
    if "rho" not in means:
        assert rho == 1.0
    if "delta" not in means:
        assert delta == 0.0


def fit_constants(model):
    """Set the constants at the hyper-parameters that the model has."""
    objective = Objective(model)
    objective.assign(objective.current()[0])
    model.eval()


@pytest.mark.parametrize("m", [1, 2])
def test_conditioning_is_rebuilding(uniform, m):
    X, Y = problem(uniform, m)
    model = fitted(X, Y)
    Z = uniform(6, 2, seed=3)
    new_X, new_Y = uniform(2, 2, seed=4), Y[:2]
    model.posterior(Z)
    conditioned = model.condition_on_observations(new_X, new_Y)
    rebuilt = CKA(
        torch.cat([X, new_X]),
        torch.cat([Y, new_Y]),
        physics=lambda X: crude(X)[..., :m],
        learn_rho_mean=True,
        learn_delta_mean=True,
        outcome_transform=model.outcome_transform,
    )
    rebuilt.load_state_dict(model.state_dict())
    torch.testing.assert_close(
        conditioned.posterior(Z).mean, rebuilt.posterior(Z).mean, rtol=1e-6, atol=1e-6
    )
    torch.testing.assert_close(
        conditioned.posterior(Z).variance, rebuilt.posterior(Z).variance, rtol=1e-4, atol=1e-8
    )


class TestCopies:
    def assert_same(self, one, other, Z, outputs=slice(None)):
        for quantity in ("posterior", "rho", "delta"):
            a, b = (getattr(model, quantity)(Z) for model in (one, other))
            torch.testing.assert_close(a.mean, b.mean[..., outputs])
            torch.testing.assert_close(a.variance, b.variance[..., outputs])

    def test_state_dict(self, uniform):
        X, Y = problem(uniform, 2)
        model = fitted(X, Y)
        state = model.state_dict()
        assert {"mean_module.rho_mean", "mean_module.delta_mean"} <= set(state)
        other = CKA(X, Y, physics=crude, learn_rho_mean=True, learn_delta_mean=True)
        other.load_state_dict(state)
        self.assert_same(other.eval(), model, uniform(5, 2, seed=3))

    def test_pickle(self, uniform):
        X, Y = problem(uniform, 2)
        model = CKA(X, Y, physics=crude, learn_rho_mean=True, learn_delta_mean=True)
        fit(model, **QUICK)
        self.assert_same(pickle.loads(pickle.dumps(model)), model, uniform(5, 2, seed=3))

    @pytest.mark.parametrize("outputs", [[0], [1], [1, 0]])
    def test_subset_output(self, uniform, outputs):
        X, Y = problem(uniform, 2)
        model = fitted(X, Y)
        subset = model.subset_output(outputs)
        self.assert_same(subset, model, uniform(5, 2, seed=3), outputs)


class TestForrester:
    """Reading A: f_true = 8 f_p - 20 x; reading B: f_true = 2 f_p - 5 x."""

    def error(self, forrester, seed, factor):
        X, Y = forrester.data(seed)
        model = CKA(
            X,
            Y * factor,
            physics=forrester.crude,
            center="mean",
            learn_rho_mean=True,
            learn_delta_mean=True,
        )
        fit(model)
        Z = forrester.test_X
        mean = model.posterior(Z).mean.detach()
        return (mean - factor * forrester.truth(Z)).square().mean().sqrt().item()

    @pytest.mark.parametrize(("factor", "limit"), [(4.0, 0.01), (1.0, 0.003)], ids=["A", "B"])
    def test_in_brief(self, forrester, factor, limit):
        errors = [self.error(forrester, seed, factor) for seed in range(3)]
        assert statistics.mean(errors) <= limit

    @pytest.mark.slow
    @pytest.mark.parametrize(("factor", "limit"), [(4.0, 0.01), (1.0, 0.003)], ids=["A", "B"])
    def test_at_length(self, forrester, factor, limit):
        errors = [self.error(forrester, seed, factor) for seed in range(20)]
        assert statistics.mean(errors) <= limit


def test_no_constant_is_learnt_unless_asked(uniform):
    X, Y = problem(uniform)
    model = CKA(X, Y, physics=lambda X: crude(X)[..., :1])
    assert not model.constant_means
    assert not any("constant" in name for name, _ in model.named_parameters())
