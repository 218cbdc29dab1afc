"""The objective of the fit against GPyTorch's marginal likelihood."""

import gpytorch
import pytest
import torch
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.mlls import ExactMarginalLogLikelihood
from gpytorch.priors import GammaPrior

from gpadjust import AR1, CKA, RRA, BiasGP, PhysicsMeanGP, ScaleGP, ZeroMeanGP
from gpadjust.inference.objective import Objective


def crude(X):
    return 2 + (3 * X).sin()


class Gain(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor(1.3, dtype=torch.float64))

    def forward(self, X):
        return self.gain * crude(X)


BUILD = {
    "ZeroMeanGP": ZeroMeanGP,
    "PhysicsMeanGP": lambda X, Y: PhysicsMeanGP(X, Y, physics=crude),
    "BiasGP": lambda X, Y: BiasGP(X, Y, physics=crude),
    "ScaleGP": lambda X, Y: ScaleGP(X, Y, physics=crude),
    "CKA": lambda X, Y: CKA(X, Y, physics=crude),
    "CKA-known-noise": lambda X, Y: CKA(X, Y, torch.full_like(Y, 0.01), physics=crude),
    "CKA-learning": lambda X, Y: CKA(X, Y, physics=Gain()),
    "AR1": lambda X, Y: AR1(X, Y, physics=crude, bounds=torch.tensor([[0.0, 0], [1, 1]])),
    "RRA": lambda X, Y: RRA(X, Y, physics=crude, num_features=16),
    "RRA-paper": lambda X, Y: RRA(X, Y, physics=crude, num_features=16, prior="paper"),
}


@pytest.fixture(params=list(BUILD))
def model(request, uniform):
    """Two outputs of two inputs."""
    X = uniform(8, 2)
    return BUILD[request.param](X, 1.5 * crude(X) + X.flip(-1))


def exact(model):
    """GPyTorch's negative log marginal likelihood, one number for each problem."""
    model.train()
    mll = ExactMarginalLogLikelihood(model.likelihood, model)
    with gpytorch.settings.cholesky_jitter(double_value=0.0):
        value = mll(model(*model.train_inputs), model.train_targets, *model.train_inputs)
    return -value * model.train_targets.shape[-1]


def neighbours(objective, k, spread=0.2):
    generator = torch.Generator().manual_seed(1)
    current = objective.current()
    noise = torch.randn(k, *current.shape[1:], generator=generator, dtype=torch.float64)
    return current + spread * noise


def test_it_is_gpytorchs_likelihood(model):
    objective = Objective(model, marginal=True)
    settings = neighbours(objective, 3)
    values = objective(settings).detach()
    assert values.shape == (3, objective.num_problems)
    for setting, value in zip(settings, values, strict=True):
        objective.assign(setting)
        expected = exact(model).detach()
        if objective.num_problems == 1:
            expected = expected.sum().reshape(1)
        torch.testing.assert_close(value, expected, rtol=1e-8, atol=1e-8)


def test_its_gradient_is_that_of_finite_differences(model):
    objective = Objective(model, marginal=True)
    settings = neighbours(objective, 2)
    values, gradient = objective.value_and_gradient(settings)
    torch.testing.assert_close(values, objective(settings).detach())
    for i in range(objective.num_parameters):
        step = torch.zeros_like(settings)
        step[..., i] = 1e-5
        difference = (objective(settings + step) - objective(settings - step)).detach() / 2e-5
        torch.testing.assert_close(gradient[..., i], difference, rtol=1e-4, atol=1e-4)


def test_priors_are_added(uniform):
    X = uniform(8, 2)

    def build(*prior):
        base = RBFKernel(ard_num_dims=2, lengthscale_prior=prior[0] if prior else None)
        kernel = ScaleKernel(base, outputscale_prior=prior[1] if prior else None)
        return CKA(
            X,
            crude(X)[:, :1] + X[:, 1:],
            physics=lambda X: crude(X)[:, :1],
            delta_covar_module=kernel.double(),
        )

    priors = GammaPrior(3.0, 6.0), GammaPrior(2.0, 0.5)
    plain, penalised = Objective(build(), True), Objective(build(*priors), True)
    settings = neighbours(plain, 3)
    with torch.no_grad():
        difference = penalised(settings) - plain(settings)
    for setting, value in zip(settings, difference, strict=True):
        penalised.assign(setting)
        kernel = penalised.model.delta_covar_module
        density = priors[0].log_prob(kernel.base_kernel.lengthscale).sum()
        density = density + priors[1].log_prob(kernel.outputscale).sum()
        torch.testing.assert_close(value, -density.detach().reshape(1))
        expected = exact(penalised.model).detach().reshape(1)
        torch.testing.assert_close(penalised(setting[None])[0].detach(), expected)


def test_packing_is_undone(model):
    objective = Objective(model, marginal=True)
    settings = neighbours(objective, 3)
    assert torch.equal(objective.flatten(objective.unflatten(settings)), settings)
    objective.assign(settings[1])
    assert torch.equal(objective.current()[0], settings[1])


def test_a_covariance_that_is_not_positive_definite_is_infinitely_bad(uniform):
    X = torch.zeros(6, 1, dtype=torch.float64)
    X[1:] += uniform(5, 1)
    model = CKA(X, crude(X), torch.full_like(X, 1e-6), physics=crude)
    objective = Objective(model, marginal=True)
    settings = objective.current().repeat(2, 1, 1)
    settings[1] = 800.0
    values, gradient = objective.value_and_gradient(settings)
    assert values[0].isfinite()
    assert values[1] == float("inf")
    assert gradient[0].isfinite().all()


def test_nothing_to_learn(uniform):
    X = uniform(8, 2)
    model = CKA(X, crude(X), physics=crude).requires_grad_(False)
    with pytest.raises(ValueError, match="no learnable parameter"):
        Objective(model, marginal=True)
