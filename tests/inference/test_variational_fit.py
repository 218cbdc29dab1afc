"""The fit of models with inducing points: the bound in plain linear algebra, and what is learnt."""

import copy
import math

import pytest
import torch
from gpytorch.constraints import Interval
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.priors import LogNormalPrior

from gpadjust import CKA, FunctionPhysics, Unknown, VariationalCKA, fit
from gpadjust.inference import collapsed_bound, variational_fit
from gpadjust.inference.collapsed_bound import CollapsedBound, Observations
from gpadjust.inference.unexplained import unexplained
from gpadjust.inference.warm_start import warm_start
from gpadjust.models.sparse_conditioning import INDUCING_NUGGET
from tests.systems import Sine, line, refused, wave

QUICK = {"num_screened": 16, "num_starts": 2}


def problem(n, seed=0, fine=0.0, noise=0.1):
    """Inputs, the function and its observations; with a bias that is fine or not."""
    generator = torch.Generator().manual_seed(seed)
    X = torch.rand(n, 1, generator=generator, dtype=torch.float64)
    f = 1.2 * wave(X) + 0.5 * X + fine * (50 * X).sin() * (9 * X).cos()
    return X, f, f + noise * torch.randn(n, 1, generator=generator, dtype=torch.float64)


def make(X, Y, *args, num_inducing=12, physics=wave, **options):
    return VariationalCKA(X, Y, *args, physics=physics, num_inducing=num_inducing, **options)


def noise_sd(model):
    return (model.likelihood.noise.sqrt() * model.units()[1]).flatten()


class Titsias:
    """Titsias (2009) for one output by inverses, in model units, of a model with center 0."""

    def __init__(self, model, X, Y, Yvar, output):
        def pick(values):
            return values.detach().reshape(-1, *values.shape[-1:])[output]

        scale = model.units()[1].flatten()[output]
        points = model.inducing_points.reshape(-1, *model.inducing_points.shape[-2:])
        Z, seen = points[output][:, :1], ~Y[:, output].isnan()
        X, self.r = X[seen], ((Y - wave(X)) / scale)[seen, output]
        rho, delta = (term.kernel for term in model.covar_module.terms)

        def k(A, B):
            parts = []
            for kernel in (rho, delta):
                length = kernel.base_kernel.lengthscale.detach().flatten()[output]
                variance = kernel.outputscale.detach().flatten()[output]
                parts.append(variance * (-0.5 * ((A - B.mT) / length).square()).exp())
            return parts[0] * (wave(A) @ wave(B).mT) / scale**2 + parts[1]

        noise = pick(model.likelihood.noise)
        noise = noise.expand(len(X)) if Yvar is None else (Yvar[seen, output] / scale**2)
        self.S, self.kuf, kuu = noise.diag(), k(Z, X), k(Z, Z)
        self.kuu = kuu + INDUCING_NUGGET * kuu.diagonal().mean() * torch.eye(len(Z)).double()
        self.kff = k(X, X).diagonal()

    def bound(self):
        q = self.kuf.mT @ self.kuu.inverse() @ self.kuf
        normal = torch.distributions.MultivariateNormal(torch.zeros_like(self.r), q + self.S)
        return normal.log_prob(self.r) - 0.5 * ((self.kff - q.diagonal()) / self.S.diagonal()).sum()

    def posterior(self):
        """Mean and covariance of the inducing values."""
        precision = self.S.inverse()
        middle = (self.kuu + self.kuf @ precision @ self.kuf.mT).inverse()
        mean = self.kuu @ middle @ self.kuf @ precision @ self.r
        return mean, self.kuu @ middle @ self.kuu


@pytest.fixture(params=["", "missing", "known noise"])
def bound_of(request, num_outputs, uniform, shuffle):
    """A model's bound at random hyper-parameters, and the formulas of each output."""
    X, _, Y = problem(25)
    Y, Yvar = torch.cat([Y, 2 * Y.flip(0)], dim=-1)[:, :num_outputs], None
    if request.param == "missing":
        Y[::4, 0] = torch.nan
        X, Y = (each[~Y.isnan().all(-1)] for each in (X, Y))
    elif request.param:
        Yvar = uniform(*Y.shape, low=0.01, high=0.1)

    def physics(X):
        return wave(X).expand(*X.shape[:-1], num_outputs)

    model = make(X, Y, Yvar, num_inducing=6, physics=physics, center=0.0)
    exact = model.exact()
    shuffle(exact, 2)
    bound = CollapsedBound(exact, Observations.of(model), model.inducing_points)
    return bound, [Titsias(model, X, Y, Yvar, j) for j in range(num_outputs)]


def test_the_bound_and_its_optimum_are_titsias(bound_of, close):
    bound, formulas = bound_of
    found = bound.optimum()
    values, _ = bound.value_and_gradient(bound.parameters.current())
    close(-values.flatten(), found[0].flatten())
    for j, formula in enumerate(formulas):
        mean, root = (t.reshape(-1, *t.shape[-k:])[j] for k, t in enumerate(found) if k)
        chol = torch.linalg.cholesky(formula.kuu)
        expected, covariance = formula.posterior()
        close(found[0].flatten()[j], formula.bound(), 1e-6)
        close(chol @ mean, expected, 1e-5)
        close(chol @ root @ root.mT @ chol.mT, covariance, 1e-4)


def test_gradient_and_parts(bound_of, close, monkeypatch):
    bound, _ = bound_of
    vector = bound.parameters.current()
    value, gradient = bound.value_and_gradient(vector)
    for i in range(vector.shape[-1]):
        step = torch.zeros_like(vector)
        step[..., i] = 1e-5
        rise = [bound.value_and_gradient(vector + sign * step)[0] for sign in (1, -1)]
        size = 1 + gradient.abs().amax(-1)
        assert ((rise[0] - rise[1]) / 2e-5 - gradient[..., i]).abs().le(1e-4 * size).all()
    monkeypatch.setattr(collapsed_bound, "_AT_ONCE", 6 * 4)
    for ours, theirs in zip(bound.value_and_gradient(vector), (value, gradient), strict=True):
        close(ours, theirs, 1e-7)


def test_rounding_does_not_lift_the_bound():
    X, _, Y = problem(300, fine=0.5)
    model = make(X, Y, num_inducing=8, center=0.0)
    with torch.no_grad():
        for term in model.covar_module.terms:
            term.kernel.base_kernel.lengthscale = 200.0
            term.kernel.outputscale = 1e10  # all but a few directions are rounding errors
    bound = CollapsedBound(model.exact(), Observations.of(model), model.inducing_points)
    best = -0.5 * len(X) * (2 * math.pi * model.likelihood.noise).log()  # with no residual at all
    assert bound.optimum()[0] < best.item()
    value, gradient = bound.value_and_gradient(bound.parameters.current())
    assert -value.item() < best.item()
    assert gradient.isfinite().all()


@pytest.mark.slow
def test_enough_points_leave_no_rest():
    X, f, Y = problem(400)
    model = make(X, Y)
    result = fit(model, **QUICK)
    assert torch.equal(result.log_likelihood, model.evidence)
    assert noise_sd(model).item() == pytest.approx(0.1, rel=0.1)
    assert model.rest.kernel.outputscale.item() < 1e-20
    lower, upper = model.interval(X)
    assert ((lower < f) & (f < upper)).double().mean() > 0.85
    assert (model.predict(X).mean - f).std() < 0.03
    exact = CKA(X, Y, physics=wave)
    fit(exact, "map", **QUICK)
    torch.testing.assert_close(model.predict(X).mean, exact.predict(X).mean, rtol=0, atol=0.03)


def test_a_fit_to_the_noise_does_not_lessen_it():
    X, _, Y = problem(150, fine=0.5)
    model = make(X, Y, num_inducing=150)
    fit(model, **QUICK)
    residuals = (Y - model.predict(X).mean).std().item()
    assert residuals < 0.95 * noise_sd(model).item()
    assert noise_sd(model).item() == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("n", [400, pytest.param(2000, marks=pytest.mark.slow)])
def test_what_few_points_cannot_show_is_in_the_intervals(n):
    X, f, Y = problem(n, fine=0.5)
    model = make(X, Y, num_inducing=6)
    fit(model, **QUICK)

    def coverage():
        lower, upper = model.interval(X)
        return ((lower < f) & (f < upper)).double().mean()

    assert coverage() > 0.85
    assert noise_sd(model).item() == pytest.approx(0.1, rel=0.15)
    with torch.no_grad():
        model.rest.kernel.outputscale = 1e-20
    model.forget()
    assert coverage() < 0.5


def test_noise_is_no_function_and_a_function_is_found(uniform):
    for d, n in ((1, 300), (3, 120)):
        for seed in range(2):
            X = uniform(n, d, seed=seed)
            residuals = torch.randn(n, generator=torch.Generator().manual_seed(seed)).double()
            found = unexplained(X, residuals, None, 0)
            assert found.variance == 0
            assert found.noise.item() == pytest.approx(1.0, rel=0.3)
    X = line(400)
    noise = 0.1 * torch.randn(2, 400, generator=torch.Generator().manual_seed(0)).double()
    residuals = torch.stack([(40 * X).sin().squeeze(-1), 0 * X.squeeze(-1)]) + noise
    residuals[0, ::5] = torch.nan
    found = unexplained(X, residuals, None, 0)
    assert 0.2 < found.variance[0] < 2.0
    assert found.variance[1] == 0
    torch.testing.assert_close(found.noise, torch.full_like(found.noise, 0.01), rtol=0.2, atol=0)
    known = unexplained(X, residuals, torch.full_like(residuals, 0.01), 0)
    assert 0.2 < known.variance[0] < 2.0
    assert known.noise.allclose(found.noise, rtol=0.2)


def test_noise_that_the_user_set_stays():
    X, _, Y = problem(300, fine=0.5)
    likelihood = GaussianLikelihood().double()
    likelihood.noise = 0.04
    model = make(X, Y, num_inducing=5, likelihood=likelihood.requires_grad_(False))
    fit(model, num_screened=0, max_iterations=3)
    assert model.likelihood.noise.item() == pytest.approx(0.04)
    assert model.rest.kernel.outputscale > 0.01
    likelihood = GaussianLikelihood(noise_constraint=Interval(0.3, 0.5)).double()
    model = make(X, Y, num_inducing=5, likelihood=likelihood)
    fit(model, num_screened=0, max_iterations=3)
    assert 0.3 < model.likelihood.noise.item() < 0.31
    assert model.likelihood.raw_noise.isfinite().all()


@pytest.mark.slow
def test_priors_count():
    X, _, Y = problem(100)
    free, bound = make(X, Y), make(X, Y)
    kernel = bound.covar_module.terms[1].kernel.base_kernel
    kernel.register_prior("lengthscale_prior", LogNormalPrior(-3.0, 0.05), "lengthscale")
    for model in (free, bound):
        fit(model, **QUICK)
    assert kernel.lengthscale.item() == pytest.approx(math.exp(-3), rel=0.1)
    assert free.covar_module.terms[1].kernel.base_kernel.lengthscale > 0.2
    assert bound.evidence < free.evidence


@pytest.mark.slow
def test_unknown_parameters_of_the_physics():
    X, f, Y = problem(120)
    physics = FunctionPhysics(
        lambda X, p: torch.sin(p["w"] * X[:, 0]), unknowns={"w": Unknown(5.0, sd=1.0)}
    )
    model = make(X, Y, physics=physics)
    fit(model, num_screened=8, num_starts=2)
    found = model.physics_parameters["w"]
    assert found.item() == pytest.approx(6.0, abs=0.2)
    assert "  w: " in model.summary()
    assert (model.predict(X).mean - f).std() < 0.05
    later = make(X, Y, physics=physics)
    warm_start(later, model)
    fit(later, num_screened=0)
    assert later.physics_parameters["w"].item() == pytest.approx(found.item(), abs=0.1)
    assert later.evidence > model.evidence - 1.0


def test_a_physics_that_learns():
    X, f, Y = problem(60)
    network = Sine(5.0)
    model = make(X, Y, physics=network)
    options = {"num_screened": 4, "num_starts": 1, "max_iterations": 10}
    fit(model, **options)
    assert network.rate.requires_grad
    assert network.rate != 5.0
    torch.testing.assert_close(model.train_inputs[0][:, 1:], network(X))
    assert (model.predict(X).mean - f).std() < 0.1


def test_several_physics_with_weights_to_learn(close):
    X, f, Y = problem(120)
    model = make(X, Y, physics={"a": wave, "b": lambda X: X.square()}, delta_mean="learn")
    fit(model, **QUICK)
    assert (model.predict(X).mean - f).std() < 0.05
    parts = model.rho(X, "a").mean * wave(X) + model.rho(X, "b").mean * X.square()
    close(parts + model.delta(X).mean, model.predict(X).mean, 1e-6)
    assert model.term_mean("rho_a") != 1.0
    draws = model.sample_functions(500, seed=0)(X[:4])
    sd = model.predict(X[:4]).variance.sqrt()
    torch.testing.assert_close(draws.std(0), sd, rtol=0.3, atol=0)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_error_leaves_the_model_as_it_was(monkeypatch, error):
    X, _, Y = problem(100)
    model = make(X, Y)
    fit(model, num_screened=0, max_iterations=2)
    before, prediction = copy.deepcopy(model.state_dict()), model.predict(X)

    def fail(*args):
        raise error

    monkeypatch.setattr(variational_fit, "unexplained", fail)
    with pytest.raises(error):
        fit(model, **QUICK, seed=1)
    assert not model.training
    for name, tensor in model.state_dict().items():
        assert torch.equal(tensor, before[name])
    assert all(map(torch.equal, model.predict(X), prediction))
    assert all(p.requires_grad for n, p in model.named_parameters() if "raw_noise" in n)


def test_options():
    model = make(*problem(10)[::2])
    refused(ValueError, "got 'bayes'", fit, model, "bayes")
    refused(ValueError, "has no option 'num_samples'", fit, model, num_samples=4)
    refused(ValueError, "Unknown method", fit, model, "vi")
    with pytest.raises(ValueError, match="no learnable parameter"):
        fit(make(*problem(10)[::2]).requires_grad_(False), num_screened=0)


def test_a_warm_start_goes_on():
    X, _, Y = problem(100)
    model = make(X, Y)
    reached = fit(model, **QUICK).log_likelihood
    again = fit(model, num_screened=0).log_likelihood
    assert again > reached - 0.5
    later = make(X, Y, seed=1)
    warm_start(later, model)
    assert fit(later, num_screened=0).log_likelihood > reached - 0.5


def test_inputs_that_repeat_or_rest():
    X, _, Y = problem(100)
    cases = {
        "repeated": torch.cat([X[:50], X[:50]]),
        "constant": torch.cat([X, torch.ones_like(X)], dim=-1),
        "all the same": torch.full_like(X, 0.3),
    }
    for name, inputs in cases.items():
        targets = torch.cat([Y[:50], Y[:50] + 0.1]) if name == "repeated" else Y
        model = make(inputs, targets)
        fit(model, num_screened=4, num_starts=1)
        error = (model.predict(inputs).mean - targets).std()
        assert error < (2.0 if name == "all the same" else 0.2)
        assert model.evidence.isfinite().all()
