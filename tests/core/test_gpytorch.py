"""What users of GPyTorch and BoTorch write runs on the core's models unchanged."""

import gpytorch
import pytest
import torch
from botorch import acquisition
from botorch.acquisition.multi_objective.logei import qLogNoisyExpectedHypervolumeImprovement
from botorch.fit import fit_gpytorch_mll
from botorch.generation import MaxPosteriorSampling
from botorch.models import ModelListGP, SingleTaskGP
from botorch.optim import optimize_acqf
from botorch.sampling import SobolQMCNormalSampler
from botorch.sampling.pathwise import draw_matheron_paths, get_matheron_path_model
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.mlls import ExactMarginalLogLikelihood, SumMarginalLogLikelihood

from gpadjust.core import CKA, PhysicsMeanGP, fit
from gpadjust.gpytorch import PhysicsMean, PhysicsScaledKernel
from tests.systems import normal, same, uniform, wave

BOUNDS = torch.tensor([[0.0, 0.0], [1.0, 1.0]], dtype=torch.float64)
SEARCH = {"num_restarts": 2, "raw_samples": 8, "options": {"maxiter": 5}}


def both(X):
    return torch.cat([wave(X), X[..., 1:].square()], -1)


def noisy():
    X = uniform(12, 2)
    Y = torch.cat([2 * wave(X) + X[:, :1], 2 * X[:, 1:].square() + 0.1], -1)
    return X, Y + 0.05 * normal(12, 2, seed=1)


@pytest.fixture
def data():
    return noisy()


@pytest.fixture(scope="module", params=["bayes", "map"])
def models(request):
    """A model of one output and one of two, fitted by each method."""
    X, Y = noisy()
    fitted = CKA(X, Y[:, :1], physics=wave), CKA(X, Y, physics=both)
    for model in fitted:
        fit(model, request.param)
    return fitted


def loss(model):
    mll = ExactMarginalLogLikelihood(model.likelihood, model)
    model.train()
    return -mll(model(*model.train_inputs), model.train_targets)


def test_three_ways_to_the_most_likely_numbers(data):
    X, Y = data
    by_adam, by_mll, by_fit = (CKA(X, Y[:, :1], physics=wave, nested=False) for _ in range(3))
    optimizer = torch.optim.Adam([p for p in by_adam.parameters() if p.requires_grad], lr=0.1)
    for _ in range(200):
        optimizer.zero_grad()
        loss(by_adam).backward()
        optimizer.step()
    assert torch.equal(by_adam.draws, by_adam.u)
    fit_gpytorch_mll(ExactMarginalLogLikelihood(by_mll.likelihood, by_mll))
    fit(by_fit, "map")
    best = loss(by_fit).item()
    assert loss(by_mll).item() == pytest.approx(loss(by_adam).item(), abs=1e-4)
    assert best < loss(by_mll).item() + 1e-5
    Z = uniform(5, 2, seed=3)
    observed = by_adam.eval().likelihood(by_adam(Z))
    expected = [v[:, 0] for v in by_adam.predict(Z, observation_noise=True)]
    same((observed.mean, observed.variance), expected)


@pytest.mark.parametrize("Yvar", [None, 0.01])
def test_the_loss_is_the_density_and_differentiable(data, Yvar):
    X, Y = data
    Y[3, 1] = torch.nan
    model = CKA(X, Y, Yvar, physics=both)
    with torch.no_grad():
        model.u += 0.3 * torch.randn(model.u.shape, dtype=torch.float64)
    value = -loss(model).sum() * len(X)
    (slope,) = torch.autograd.grad(value, model.u)
    _, expected = model.log_likelihood(model.u.detach())
    torch.testing.assert_close(slope, expected - model.u.detach(), rtol=1e-6, atol=1e-6)


def test_lists_of_models(data):
    X, Y = data
    ours, theirs = CKA(X, Y[:, :1], physics=wave), SingleTaskGP(X, Y[:, 1:])
    both_models = ModelListGP(ours, theirs)
    fit_gpytorch_mll(SumMarginalLogLikelihood(both_models.likelihood, both_models))
    fit(ours, num_draws=16)
    Z = uniform(5, 2, seed=3)
    posterior = both_models.posterior(Z)
    same((posterior.mean[:, :1], posterior.variance[:, :1]), ours.predict(Z))
    assert posterior.rsample(torch.Size([3])).shape == (3, 5, 2)
    plain = ModelListGP(ours, CKA(X, Y[:, 1:], physics=lambda X: X[:, 1:]))
    later = plain.condition_on_observations([Z, Z], uniform(5, 2, seed=4))
    assert later.posterior(Z).mean.shape == (5, 2)


def test_state(data, models):
    X, Y = data
    Z = uniform(5, 2, seed=3)
    again = CKA(X, Y, physics=both)
    again.load_state_dict(models[1].state_dict())
    assert torch.equal(again.predict(Z).variance, models[1].predict(Z).variance)


@pytest.mark.parametrize("name", ["LogEI", "qLogEI", "qLogNEI", "qKG", "qLogNEHVI"])
def test_acquisition(models, data, name):
    X, Y = data
    one, two = models
    sampler, best = SobolQMCNormalSampler(torch.Size([16])), Y[:, 0].max()
    function = {
        "LogEI": lambda: acquisition.LogExpectedImprovement(one, best),
        "qLogEI": lambda: acquisition.qLogExpectedImprovement(one, best, sampler=sampler),
        "qLogNEI": lambda: acquisition.qLogNoisyExpectedImprovement(one, X, sampler=sampler),
        "qKG": lambda: acquisition.qKnowledgeGradient(one, num_fantasies=4),
        "qLogNEHVI": lambda: qLogNoisyExpectedHypervolumeImprovement(
            two.subset_draws(torch.arange(len(two.u))[:8]),
            ref_point=[0.0, 0.0],
            X_baseline=X,
            sampler=sampler,
        ),
    }[name]()
    q = 2 if name.startswith("q") else 1
    candidates, value = optimize_acqf(function, BOUNDS, q=q, **SEARCH)
    assert candidates.shape == (q, 2)
    assert value.isfinite().all()


def test_thompson_samples_and_paths(models):
    one, two = models
    X = uniform(6, 2, seed=5)
    assert MaxPosteriorSampling(one)(X, num_samples=5).shape == (5, 2)
    assert MaxPosteriorSampling(one)(X.expand(3, 6, 2), num_samples=5).shape == (3, 5, 2)
    assert draw_matheron_paths(one, torch.Size([2, 3]))(X).shape == (2, 3, 6)
    assert draw_matheron_paths(two, torch.Size([3]))(X).shape == (3, 2, 6)
    assert get_matheron_path_model(two)(X).shape == (6, 2)
    assert get_matheron_path_model(two, torch.Size([3]))(X.expand(3, 6, 2)).shape == (3, 6, 2)


def test_it_reads_as_a_gpytorch_model(models):
    Z = uniform(5, 2, seed=3)
    for model, physics in zip(models, (wave, both), strict=True):
        S, m = len(model.u), model.num_outputs
        lead = [size for size in (S, m) if size > 1]
        if not model.values.get("rho.mean", torch.zeros(1)).any():  # no draw without physics
            expected = physics(Z).mT.expand(S, m, 5)
            torch.testing.assert_close(model.mean_module(Z), expected.reshape(*lead, 5))
        K = model.covar_module(Z).to_dense()
        assert K.shape == (*lead, 5, 5)
        torch.testing.assert_close(model.forward(Z).covariance_matrix, K)
        diagonal = model.covar_module(Z, diag=True)
        torch.testing.assert_close(diagonal, K.diagonal(dim1=-1, dim2=-2))
        # rho's part of equation 2 is the kernel of rho, scaled by f_p - c on both sides.
        values = model.values
        f = physics(Z).mT - model.term_sum.center(model.terms[0], values) * model.unit
        k = model.terms[0].kernel.covariance(model.evaluate(Z).own(model.terms[0]), Z)
        k = k * values.get("rho.process", torch.ones(1)).unsqueeze(-1)
        k = (k + values["rho.constant"].unsqueeze(-1)) * f.unsqueeze(-1) * f.unsqueeze(-2)
        rho = model.covar_module.kernels[0](Z).to_dense()
        torch.testing.assert_close(rho, k.reshape(rho.shape))


class OwnCKA(gpytorch.models.ExactGP):
    """The paper's model in ordinary modules."""

    def __init__(self, X, y, likelihood, f_p):
        super().__init__(X, y, likelihood)
        self.mean_module = PhysicsMean(f_p)
        self.rho_covar_module = PhysicsScaledKernel(ScaleKernel(RBFKernel(ard_num_dims=2)), f_p)
        self.delta_covar_module = ScaleKernel(RBFKernel(ard_num_dims=2))

    def forward(self, x):
        covar = self.rho_covar_module(x) + self.delta_covar_module(x)
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), covar)


def test_an_exact_gp_of_ones_own_is_cka(data):
    X, Y = data
    Z = uniform(5, 2, seed=3)
    model = CKA(X, Y[:, :1], physics=wave, center=0.0, constants=False)
    model.set_draws(model.u + 0.2 * torch.randn(model.u.shape, dtype=torch.float64))
    own = OwnCKA(X, Y[:, 0], gpytorch.likelihoods.GaussianLikelihood(), wave).double()
    values, unit = model.values, model.unit.item()
    rho, delta = own.rho_covar_module.base_kernel, own.delta_covar_module
    for kernel, name, size in ((rho, "rho", 1.0), (delta, "delta", unit)):
        kernel.base_kernel.lengthscale = values[f"{name}.kernel.lengthscale"].detach()[0]
        kernel.outputscale = values[f"{name}.kernel.outputscale"].detach()[0, 0, 0] * size**2
    own.likelihood.noise = model.likelihood.noise.detach()[0]
    own.eval()
    with torch.no_grad(), gpytorch.settings.fast_computations(False, False, False):
        posterior = own(Z)
        expected = model.predict(Z)
        torch.testing.assert_close(posterior.mean, expected.mean[:, 0], rtol=1e-10, atol=1e-10)
        variance = posterior.variance
    torch.testing.assert_close(variance, expected.variance[:, 0], rtol=1e-8, atol=1e-10)


def test_a_fitted_model_is_a_physics_by_its_predictions():
    X = uniform(12, 1)
    Y = 1.3 * wave(X) + X + 0.05 * normal(12, 1, seed=1)
    old = PhysicsMeanGP(X, Y, physics=wave)
    new = CKA(X, 2 * Y, physics=lambda X: old.predict(X).mean)
    assert (new.predict(X).mean - 2 * Y).abs().max() < 0.2
