"""The fit: never worse than its start, reproducible, and honouring the user's choices."""

import pytest
import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.fit import fit_gpytorch_mll
from botorch.models import ModelListGP, SingleTaskGP
from gpytorch.constraints import Interval
from gpytorch.kernels import MaternKernel, RBFKernel, ScaleKernel
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.priors import LogNormalPrior

from gpadjust import AR1, CKA, RRA, BiasGP, FitResult, PhysicsMeanGP, ScaleGP, ZeroMeanGP, fit
from gpadjust.inference.objective import Objective

QUICK = {"num_screened": 16, "num_starts": 2}


def crude(X):
    return 2 + (3 * X).sin()


BUILD = {
    "ZeroMeanGP": ZeroMeanGP,
    "PhysicsMeanGP": lambda *data: PhysicsMeanGP(*data, physics=crude),
    "BiasGP": lambda *data: BiasGP(*data, physics=crude),
    "ScaleGP": lambda *data: ScaleGP(*data, physics=crude),
    "CKA": lambda *data: CKA(*data, physics=crude),
    "AR1": lambda *data: AR1(*data, physics=crude, num_low=12, bounds=[[0.0, 0.0], [1.0, 1.0]]),
    "RRA": lambda *data: RRA(*data, physics=crude, num_features=16),
    "RRA-paper": lambda *data: RRA(*data, physics=crude, num_features=16, prior="paper"),
}


@pytest.fixture
def XY(uniform):
    X = uniform(9, 2)
    # With noise: a fit without it is determined to rounding errors only.
    return X, 1.5 * crude(X) + X.flip(-1) + 0.1 * uniform(9, 2, seed=5)


@pytest.fixture(
    params=[
        pytest.param(kind, marks=pytest.mark.slow if kind in ("AR1", "BiasGP", "RRA-paper") else ())
        for kind in BUILD
    ]
)
def model(request, XY):
    """Each model of two outputs of two inputs."""
    return BUILD[request.param](*XY)


def log_likelihood(model):
    model.train()
    mll = ExactMarginalLogLikelihood(model.likelihood, model)
    with torch.no_grad():
        value = mll(model(*model.train_inputs), model.train_targets, *model.train_inputs)
    model.eval()
    return value * model.train_targets.shape[-1]


class TestResult:
    def test_likelihood_and_mode(self, model):
        before = log_likelihood(model)
        result = fit(model, **QUICK)
        assert isinstance(result, FitResult)
        assert not model.training
        assert result.converged.all()
        assert result.converged.shape == result.log_likelihood.shape
        after = log_likelihood(model)
        torch.testing.assert_close(result.log_likelihood, after, rtol=1e-6, atol=1e-6)
        assert (after > before).all()

    @pytest.mark.parametrize("num_screened", [0, 8])
    def test_never_worse_than_the_start(self, model, num_screened):
        fit(model, num_starts=2, num_screened=32)
        good = log_likelihood(model)
        # From a good start, one random start more or a single iteration must not lose it.
        for seed in range(2):
            fit(model, num_starts=1, num_screened=num_screened, seed=seed)
            assert (log_likelihood(model) >= good - 1e-6 * good.abs()).all()

    @pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.OptimizationWarning")
    def test_never_worse_when_stopped_at_once(self, model):
        before = log_likelihood(model)
        fit(model, num_starts=1, num_screened=0, max_iterations=1)
        assert (log_likelihood(model) >= before).all()

    def test_a_start_outside_the_search_is_kept(self, XY):
        model = CKA(*XY, physics=crude)
        model.rho_covar_module.base_kernel.raw_lengthscale.requires_grad_(False)
        with torch.no_grad():
            model.rho_covar_module.base_kernel.raw_lengthscale.fill_(30.0)
            model.delta_covar_module.base_kernel.raw_lengthscale.fill_(20.0)
        before = log_likelihood(model)
        fit(model, num_screened=0)
        assert (log_likelihood(model) >= before).all()
        assert (model.rho_covar_module.base_kernel.raw_lengthscale == 30.0).all()

    def test_model_list(self, XY):
        X, Y = XY
        models = [CKA(X, Y, physics=crude), BiasGP(X[:6], Y[:6], physics=crude)]
        before = [log_likelihood(model) for model in models]
        results = fit(ModelListGP(*models), **QUICK)
        assert len(results) == 2
        for model, result, start in zip(models, results, before, strict=True):
            assert (result.log_likelihood > start).all()
            torch.testing.assert_close(result.log_likelihood, log_likelihood(model))
        again = fit(ModelListGP(*models), num_screened=0, num_starts=1)
        for first, second in zip(results, again, strict=True):
            assert (second.log_likelihood >= first.log_likelihood - 1e-6).all()

    def test_botorchs_own_model(self, XY):
        X, Y = XY
        model = SingleTaskGP(X, Y)
        before = log_likelihood(model)
        assert (fit(model, **QUICK).log_likelihood > before).all()


class TestSeed:
    def test_the_same_seed_gives_the_same_fit(self, XY):
        models = [CKA(*XY, physics=crude) for _ in range(2)]
        for model in models:
            torch.rand(3)
            fit(model, seed=3, **QUICK)
        for a, b in zip(models[0].parameters(), models[1].parameters(), strict=True):
            assert torch.equal(a, b)

    def test_other_seeds_draw_other_starts(self, XY):
        values = set()
        for seed in (1, 2):
            model = CKA(*XY, physics=crude)
            with pytest.warns(OptimizationWarning):
                fit(model, seed=seed, num_screened=64, num_starts=1, max_iterations=1)
            values.add(tuple(log_likelihood(model).tolist()))
        assert len(values) == 2

    def test_the_global_generator_is_left_alone(self, model):
        state = torch.get_rng_state()
        fit(model, **QUICK)
        assert torch.equal(torch.get_rng_state(), state)


def test_no_convergence_is_said(XY):
    model = CKA(*XY, physics=crude)
    with pytest.warns(OptimizationWarning, match="did not converge for 2 of 2 outputs within 1"):
        result = fit(model, max_iterations=1)
    assert not result.converged.any()


class TestOutputs:
    @pytest.mark.parametrize("kind", ["CKA", "BiasGP", "RRA"])
    def test_outputs_are_fitted_as_if_alone(self, XY, kind):
        X, Y = XY
        both = BUILD[kind](X, Y)
        fit(both, num_screened=0)
        for j in range(2):

            def physics(X, j=j):
                return crude(X)[..., [j]]

            options = {"num_features": 16} if kind == "RRA" else {}
            single = type(both)(X, Y[:, [j]], physics=physics, **options)
            result = fit(single, num_screened=0)
            expected = log_likelihood(both)[j]
            torch.testing.assert_close(result.log_likelihood, expected, rtol=1e-4, atol=1e-4)
            Z = X + 0.05
            torch.testing.assert_close(
                single.posterior(Z).mean[:, 0], both.posterior(Z).mean[:, j], rtol=1e-2, atol=1e-2
            )

    @pytest.mark.slow
    def test_outputs_find_the_optima_they_find_alone(self, XY):
        X, Y = XY
        both = CKA(X, Y, physics=crude)
        fit(both)
        for j in range(2):
            single = CKA(X, Y[:, [j]], physics=lambda X, j=j: crude(X)[..., [j]])
            result = fit(single)
            torch.testing.assert_close(
                result.log_likelihood, log_likelihood(both)[j], rtol=1e-2, atol=0.05
            )

    def test_a_batch_of_data_sets(self, uniform):
        X = uniform(3, 8, 2)
        model = CKA(X, 1.5 * crude(X) + X.flip(-1), physics=crude)
        before = log_likelihood(model)
        result = fit(model, num_screened=8, num_starts=1)
        assert result.log_likelihood.shape == (3, 2)
        assert (result.log_likelihood > before).all()


class Pendulum(torch.nn.Module):
    """f_p(x) = sin(rate x), with a rate to be learnt."""

    def __init__(self, rate):
        super().__init__()
        self.rate = torch.nn.Parameter(torch.tensor(rate, dtype=torch.float64))

    def forward(self, X):
        return (self.rate * X).sin()


class TestLearningPhysics:
    @pytest.fixture
    def model(self, uniform):
        X = uniform(20, 1, high=3.0)
        noise = 0.01 * torch.randn(20, 1, dtype=torch.float64)
        return CKA(X, (2.0 * X).sin() + 0.05 * X + noise, physics=Pendulum(1.8))

    def test_by_fit(self, model):
        start = log_likelihood(model)
        fit(model, **QUICK)
        assert log_likelihood(model) > start
        assert model.physics.function.rate.item() == pytest.approx(2.0, abs=0.1)

    def test_by_botorch(self, model):
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
        assert model.physics.function.rate.item() == pytest.approx(2.0, abs=0.1)

    def test_predictions_use_what_was_learnt(self, model):
        fit(model, **QUICK)
        far = torch.tensor([[400.0]], dtype=torch.float64)
        expected = (model.physics.function.rate * far).sin()
        with torch.no_grad():
            model.delta_covar_module.base_kernel.raw_lengthscale.fill_(0.0)
            model.rho_covar_module.base_kernel.raw_lengthscale.fill_(0.0)
        model.train()
        torch.testing.assert_close(model.posterior(far).mean, expected)

    @pytest.mark.slow
    @pytest.mark.parametrize("seed", [1, 3])
    def test_the_users_guess_is_not_lost_among_aliases(self, seed):
        X = torch.linspace(0, 3, 15, dtype=torch.float64).unsqueeze(-1)
        model = CKA(X, 1.7 * (3 * X).sin() + 0.05 * X, physics=Pendulum(2.5))
        fit(model, seed=seed)
        assert model.physics.function.rate.item() == pytest.approx(3.0, abs=0.05)

    def test_of_several_outputs(self, uniform):
        class Shared(torch.nn.Module):
            def __init__(self):
                super().__init__()
                self.rate = torch.nn.Parameter(torch.tensor(1.8, dtype=torch.float64))

            def forward(self, X):
                return torch.cat([(self.rate * X).sin(), (self.rate * X).cos()], dim=-1)

        X = uniform(15, 1, high=3.0)
        model = BiasGP(X, torch.cat([(2 * X).sin(), (2 * X).cos() + 0.1], -1), physics=Shared())
        result = fit(model, **QUICK)
        assert result.log_likelihood.shape == ()
        assert model.physics.function.rate.item() == pytest.approx(2.0, abs=0.05)


class TestUsersChoices:
    def test_priors_are_honoured(self, XY):
        X, Y = XY
        lengthscales = []
        for centre in (-3.0, 1.0):
            prior = LogNormalPrior(centre, 0.02)
            base = MaternKernel(
                ard_num_dims=2, batch_shape=torch.Size([2]), lengthscale_prior=prior
            )
            kernel = ScaleKernel(base, batch_shape=torch.Size([2]))
            model = CKA(X, Y, physics=crude, delta_covar_module=kernel.double())
            fit(model, num_screened=8, num_starts=1)
            lengthscales.append(base.lengthscale.log())
        torch.testing.assert_close(
            lengthscales[0], torch.full((2, 1, 2), -3.0, dtype=torch.float64), rtol=0, atol=0.1
        )
        torch.testing.assert_close(
            lengthscales[1], torch.full((2, 1, 2), 1.0, dtype=torch.float64), rtol=0, atol=0.1
        )

    def test_fixed_parameters_stay(self, XY):
        model = CKA(*XY, physics=crude)
        fixed = model.delta_covar_module.base_kernel.raw_lengthscale
        fixed.requires_grad_(False)
        before, free = fixed.clone(), model.likelihood.noise.clone()
        fit(model, **QUICK)
        assert torch.equal(fixed, before)
        assert not fixed.requires_grad
        assert not torch.equal(model.likelihood.noise, free)

    def test_the_users_constraints_hold(self, XY):
        base = RBFKernel(batch_shape=torch.Size([2]), lengthscale_constraint=Interval(0.3, 0.4))
        kernel = ScaleKernel(base, batch_shape=torch.Size([2]))
        model = CKA(*XY, physics=crude, delta_covar_module=kernel.double())
        fit(model, **QUICK)
        assert ((base.lengthscale >= 0.3) & (base.lengthscale <= 0.4)).all()

    def test_the_noise_may_be_known(self, XY):
        X, Y = XY
        model = CKA(X, Y, torch.full_like(Y, 0.01), physics=crude)
        before = log_likelihood(model)
        fit(model, **QUICK)
        assert (log_likelihood(model) > before).all()


class TestBadInput:
    @pytest.mark.parametrize(
        ("option", "least"), [("num_starts", 1), ("num_screened", 0), ("max_iterations", 1)]
    )
    def test_options(self, XY, option, least):
        model = CKA(*XY, physics=crude)
        with pytest.raises(ValueError, match=f"Expected {option} >= {least}, got {least - 1}"):
            fit(model, **{option: least - 1})

    def test_another_kind_of_model(self):
        with pytest.raises(TypeError, match=r"Expected a model of gpadjust.*got Linear"):
            fit(torch.nn.Linear(2, 1))

    def test_nothing_to_learn(self, XY):
        with pytest.raises(ValueError, match="no learnable parameter"):
            fit(CKA(*XY, physics=crude).requires_grad_(False))

    def test_a_likelihood_that_cannot_be_evaluated(self, XY):
        model = CKA(*XY, physics=crude)
        with torch.no_grad():
            model.rho_covar_module.raw_outputscale.fill_(float("nan"))
        model.rho_covar_module.raw_outputscale.requires_grad_(False)
        before = Objective(model).current()
        with pytest.raises(RuntimeError, match="could not be evaluated at any start"):
            fit(model, **QUICK)
        assert torch.equal(Objective(model).current(), before)
        model.eval()
