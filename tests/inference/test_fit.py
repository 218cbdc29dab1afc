"""The fit: never worse than its start, reproducible, and honouring the user's choices."""

import pytest
import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models import ModelListGP, SingleTaskGP
from gpytorch.constraints import Interval
from gpytorch.kernels import MaternKernel, ScaleKernel
from gpytorch.priors import LogNormalPrior
from torch.distributions import MultivariateNormal

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, ZeroMeanGP, fit
from gpadjust.gp.gaussian import nugget
from gpadjust.inference import FitResult, optimise
from gpadjust.models import BiasGP
from gpadjust.models.parameters import LogInterval
from tests.systems import Sine, line, ripple, wave

pytestmark = pytest.mark.filterwarnings("ignore::gpadjust.PhysicsWarning")

QUICK = {"num_screened": 16, "num_starts": 2}


BUILD = {
    "ZeroMeanGP": ZeroMeanGP,
    "PhysicsMeanGP": lambda *data: PhysicsMeanGP(*data, physics=ripple),
    "CKA": lambda *data: CKA(*data, physics=ripple),
    "AR1": lambda *data: AR1(*data, physics=ripple, num_low=12, bounds=[[0.0, 0.0], [1.0, 1.0]]),
    "RRA": lambda *data: RRA(*data, physics=ripple, num_features=16),
}


@pytest.fixture
def XY(uniform):
    X = uniform(9, 2)
    # With noise: a fit without it is determined to rounding errors only.
    return X, 1.5 * ripple(X) + X.flip(-1) + 0.1 * uniform(9, 2, seed=5)


SLOW = ("AR1", "ZeroMeanGP")


@pytest.fixture(
    params=[pytest.param(k, marks=pytest.mark.slow if k in SLOW else ()) for k in BUILD]
)
def model(request, XY):
    """Each model of two outputs of two inputs."""
    return BUILD[request.param](*XY)


def log_likelihood(model):
    """That of a multivariate normal, with the nugget that is always there."""
    model.train()
    with torch.no_grad():
        prior = model.likelihood(model(*model.train_inputs), *model.train_inputs)
        covariance = prior.covariance_matrix
        n = covariance.shape[-1]
        size = nugget(n) * covariance.diagonal(dim1=-1, dim2=-2)
        covariance = covariance + torch.diag_embed(size)
        value = MultivariateNormal(prior.mean, covariance).log_prob(model.train_targets)
    model.eval()
    return value


class TestResult:
    def test_likelihood_and_mode(self, model):
        before = log_likelihood(model)
        result = fit(model, "map", **QUICK)
        assert isinstance(result, FitResult)
        assert not model.training
        assert result.converged.all()
        assert result.converged.shape == result.log_likelihood.shape
        after = log_likelihood(model)
        torch.testing.assert_close(result.log_likelihood, after, rtol=1e-5, atol=1e-6)
        assert (after > before).all()

    @pytest.mark.parametrize("num_screened", [0, 8])
    def test_never_worse_than_the_start(self, model, num_screened):
        fit(model, "map", num_starts=2, num_screened=32)
        good = log_likelihood(model)
        # From a good start, one random start more or a single iteration must not lose it.
        for seed in range(2):
            fit(model, "map", num_starts=1, num_screened=num_screened, seed=seed)
            assert (log_likelihood(model) >= good - 1e-6 * good.abs()).all()

    def test_a_start_outside_the_search_is_kept(self, XY):
        model = CKA(*XY, physics=ripple)
        lengthscales = [term.kernel.base_kernel.raw_lengthscale for term in model.terms]
        lengthscales[0].requires_grad_(False)
        with torch.no_grad():
            lengthscales[0].fill_(30.0)
            lengthscales[1].fill_(20.0)
        before = log_likelihood(model)
        fit(model, "map", num_screened=0)
        assert (log_likelihood(model) >= before).all()
        assert (lengthscales[0] == 30.0).all()

    def test_model_lists_and_botorchs_own_model(self, XY):
        X, Y = XY
        models = [CKA(X, Y, physics=ripple), BiasGP(X[:6], Y[:6], physics=ripple)]
        before = [log_likelihood(model) for model in models]
        results = fit(ModelListGP(*models), "map", **QUICK)
        assert len(results) == 2
        for model, result, start in zip(models, results, before, strict=True):
            assert (result.log_likelihood > start).all()
            torch.testing.assert_close(result.log_likelihood, log_likelihood(model))
        again = fit(ModelListGP(*models), "map", num_screened=0, num_starts=1)
        for first, second in zip(results, again, strict=True):
            assert (second.log_likelihood >= first.log_likelihood - 1e-6).all()
        model = SingleTaskGP(X, Y)
        before = log_likelihood(model)
        assert (fit(model, "map", **QUICK).log_likelihood > before).all()


def test_no_convergence_is_said(model):
    before = log_likelihood(model)
    with pytest.warns(OptimizationWarning, match="not converge for 2 of 2 outputs"):
        result = fit(model, "map", num_screened=0, num_starts=1, max_iterations=1)
    assert not result.converged.any()
    assert (log_likelihood(model) >= before).all()


class TestOutputs:
    @pytest.mark.parametrize(
        ("kind", "num_screened"),
        [("CKA", 0), ("RRA", 0), pytest.param("CKA", None, marks=pytest.mark.slow)],
    )
    def test_outputs_are_fitted_as_if_alone(self, XY, kind, num_screened):
        X, Y = XY
        tolerance = 1e-4 if num_screened == 0 else 0.05
        both = BUILD[kind](X, Y)
        fit(both, "map", num_screened=num_screened)
        options = {"num_features": 16} if kind == "RRA" else {}
        for j in range(2):
            single = type(both)(X, Y[:, [j]], physics=lambda X, j=j: ripple(X)[..., [j]], **options)
            found = fit(single, "map", num_screened=num_screened).log_likelihood
            torch.testing.assert_close(found, log_likelihood(both)[j], rtol=1e-4, atol=tolerance)
            if num_screened == 0:
                Z = X + 0.05
                actual, expected = single.posterior(Z).mean[:, 0], both.posterior(Z).mean[:, j]
                torch.testing.assert_close(actual, expected, rtol=1e-2, atol=1e-2)


class TestManyPoints:
    """The search is made on some rows, and its best optima are refined on all."""

    @pytest.fixture(params=["one input", "two outputs", "little noise"])
    def problem(self, request, uniform):
        d = 1 if request.param == "one input" else 2
        X = uniform(200, d, seed=3)
        Y = (1 + X[:, :1]) * ripple(6 * X[:, :1]) + X.sum(-1, keepdim=True).square()
        if request.param == "two outputs":
            Y = torch.cat([Y, (9 * X[:, :1]).sin() + 2 * ripple(6 * X[:, :1])], dim=-1)
            Y[::7, 0] = torch.nan
        sd = 1e-4 if request.param == "little noise" else 0.1
        Y = Y + sd * torch.randn(Y.shape, dtype=torch.float64)
        return lambda: CKA(X, Y, physics=lambda X: ripple(6 * X[:, :1]).expand(-1, Y.shape[-1]))

    @pytest.mark.slow
    def test_it_is_as_good_as_a_search_on_all(self, problem, monkeypatch):
        found = fit(problem(), "map").log_likelihood
        monkeypatch.setattr(optimise, "MANY", 1000)
        expected = fit(problem(), "map").log_likelihood
        assert (found >= expected - 0.1 - 2e-3 * expected.abs()).all()


class TestLearningPhysics:
    @pytest.fixture
    def model(self, uniform):
        X = uniform(20, 1, high=3.0)
        noise = 0.01 * torch.randn(20, 1, dtype=torch.float64)
        return CKA(X, (2.0 * X).sin() + 0.05 * X + noise, physics=Sine(1.8), center=0.0)

    @pytest.mark.slow
    def test_predictions_use_what_was_learnt(self, model):
        start = log_likelihood(model)
        fit(model, "map", **QUICK)
        assert log_likelihood(model) > start
        assert model.physics.function.rate.item() == pytest.approx(2.0, abs=0.1)
        far = torch.tensor([[400.0]], dtype=torch.float64)
        expected = (model.physics.function.rate * far).sin()
        with torch.no_grad():
            for term in model.terms:
                term.kernel.base_kernel.raw_lengthscale.fill_(0.0)
        model.train()
        torch.testing.assert_close(model.posterior(far).mean, expected)

    @pytest.mark.slow
    def test_the_users_guess_is_not_lost_among_aliases(self):
        X = line(15, 0, 3)
        model = CKA(X, 1.7 * (3 * X).sin() + 0.05 * X, physics=Sine(2.5))
        fit(model, "map", seed=1)
        assert model.physics.function.rate.item() == pytest.approx(3.0, abs=0.05)


class TestUsersChoices:
    def test_priors_are_honoured(self, XY):
        batch = torch.Size([2])
        for center in (-3.0, 1.0):
            prior = LogNormalPrior(center, 0.02)
            base = MaternKernel(ard_num_dims=2, batch_shape=batch, lengthscale_prior=prior)
            kernel = ScaleKernel(base, batch_shape=batch).double()
            model = CKA(*XY, physics=ripple, delta_covar_module=kernel)
            fit(model, "map", num_screened=8, num_starts=1)
            assert ((base.lengthscale.log() - center).abs() < 0.1).all()

    def test_fixed_parameters_stay(self, XY):
        model = CKA(*XY, physics=ripple)
        fixed = model.terms[1].kernel.base_kernel.raw_lengthscale
        fixed.requires_grad_(False)
        before, free = fixed.clone(), model.likelihood.noise.clone()
        fit(model, "map", **QUICK)
        assert torch.equal(fixed, before)
        assert not fixed.requires_grad
        assert not torch.equal(model.likelihood.noise, free)

    @pytest.mark.parametrize("constraint", [Interval, LogInterval])
    @pytest.mark.parametrize(("lower", "upper"), [(1e-3, 2e-3), (0.4, 0.5), (1e3, 2e3)])
    @pytest.mark.parametrize("kind", ["lengthscale", "outputscale"])
    def test_an_interval(self, XY, kind, constraint, lower, upper):
        batch, interval = torch.Size([2]), {f"{kind}_constraint": constraint(lower, upper)}
        inner, outer = (interval if kind == each else {} for each in ("lengthscale", "outputscale"))
        base = MaternKernel(ard_num_dims=2, batch_shape=batch, **inner)
        kernel = ScaleKernel(base, batch_shape=batch, **outer).double()
        setattr(base if inner else kernel, kind, (lower + upper) / 2)
        model = CKA(*XY, physics=ripple, rho_covar_module=kernel)
        assert fit(model, "map", **QUICK).log_likelihood.isfinite().all()
        values = getattr(base if inner else kernel, kind)
        # GPyTorch keeps the bounds in float32.
        assert (values >= lower * (1 - 1e-6)).all()
        assert (values <= upper * (1 + 1e-6)).all()


@pytest.mark.slow
def test_a_part_that_shows_nothing_but_noise_does_not_decide():
    # On the 96 of these rows that are searched first, the likeliest function is none at all.
    generator = torch.Generator().manual_seed(0)
    X = torch.rand(300, 3, generator=generator, dtype=torch.float64)
    Y = 2 * wave(X) + torch.sin(9 * X[:, 1:2]) * torch.cos(9 * X[:, 2:])
    Y = Y + 0.2 * torch.randn(300, 1, generator=generator, dtype=torch.float64)
    model = CKA(X, Y, physics=wave)
    assert fit(model, "map").log_likelihood > -41
