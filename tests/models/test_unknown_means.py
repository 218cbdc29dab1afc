"""Unknown constant means of rho and delta: universal kriging, after a fit."""

import pickle
import statistics

import pytest
import torch

from gpadjust import CKA, RRA, PhysicsMeanGP, ScaleGP, fit

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
        **{f"{name}_mean": "learn" for name in means},
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
        rho, delta = (term.kernel for term in model.terms)
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

    model = PhysicsMeanGP(X, factor * physics(X), physics=physics, rho_mean="learn")
    fit(model, **QUICK)
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
    fit(model.train(), num_screened=0, num_starts=1)  # the constants at these lengthscales
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


@pytest.mark.parametrize(
    ("cls", "m"), [(CKA, 1), (CKA, 2), (PhysicsMeanGP, 2), (ScaleGP, 1), (RRA, 2)]
)
def test_conditioning_and_copies(uniform, same, cls, m):
    X, Y = problem(uniform, m)
    Z, options = uniform(6, 2, seed=3), {"rho_mean": "learn", "delta_mean": "learn"}
    if cls is ScaleGP:
        options.pop("delta_mean")

    def build(*data):
        return cls(*data, physics=Column(m), **options)

    model = build(X, Y)
    fit(model, **QUICK)
    with torch.no_grad():
        model.likelihood.noise_covar.raw_noise.fill_(-7.0)
    new_X, new_Y = uniform(2, 2, seed=4), Y[:2]
    rebuilt = build(torch.cat([X, new_X]), torch.cat([Y, new_Y]))
    rebuilt.load_state_dict(model.state_dict())
    same(model.condition_on_observations(new_X, new_Y), rebuilt.eval(), Z, 1e-5)
    same(pickle.loads(pickle.dumps(model)), model, Z, 1e-12)
    if m > 1:
        for outputs in ([0], [1, 0]):
            same(model.subset_output(outputs), model, Z, 1e-9, outputs)


class Column(torch.nn.Module):
    """The first columns of the crude physics."""

    def __init__(self, m):
        super().__init__()
        self.m = m

    def forward(self, X):
        return crude(X)[..., : self.m]


class TestForrester:
    """Reading A: f_true = 8 f_p - 20 x; reading B: f_true = 2 f_p - 5 x."""

    def error(self, forrester, seed, factor):
        X, Y = forrester.data(seed)
        model = CKA(
            X,
            Y * factor,
            physics=forrester.crude,
            center="mean",
            rho_mean="learn",
            delta_mean="learn",
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
