"""The default priors, and densities of priors in an objective."""

import pytest
import torch
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.priors import GammaPrior, LogNormalPrior
from torch.distributions import LogNormal, Normal

from gpadjust import CKA
from gpadjust.inference import register_priors
from gpadjust.inference.targets import LogPosterior, Target
from tests.systems import crude


def priors(model):
    return {name: prior for name, _, prior, _, _ in model.named_priors()}


def test_densities(build, data, num_outputs):
    X, Y = data(num_outputs=num_outputs)
    X = X * torch.tensor([1.0, 100.0])
    model = build(
        "CKA", X, Y, physics=lambda X: 3 + X[..., :1].expand_as(Y), outcome_transform=None
    )
    register_priors(model)
    found = priors(model)
    v = (Y - 3 - X[:, :1]).square().mean(0).minimum(Y.var(0, correction=0))
    length = (X.amax(0) - X.amin(0)) * 2
    lengths, rho, delta = length.repeat(num_outputs), "terms.0.kernel", "terms.1.kernel"
    medians = {
        "likelihood.noise_covar.noise_prior": (1e-3 * v, 4),
        f"covar_module.{delta}.outputscale_prior": (v, 6),
        f"covar_module.{rho}.outputscale_prior": (v * 0 + 0.01, 4),
        f"covar_module.{delta}.base_kernel.lengthscale_prior": (lengths, 2),
        f"covar_module.{rho}.base_kernel.lengthscale_prior": (lengths, 2),
    }
    assert set(found) == set(medians)
    for name, (middle, sd) in medians.items():
        actual = found[name].log_prob(torch.full_like(found[name].loc, 0.7)).flatten()
        expected = LogNormal(middle.log(), sd).log_prob(torch.full_like(middle, 0.7))
        torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_of_ar1(build, data, num_outputs, unit):
    X, Y = data(num_outputs=num_outputs)
    model = build("AR1", X, unit * Y)
    register_priors(model)
    ratio = model.data()["train_Y"].std(0) / model.data()["low_Y"].std(0)
    expected = Normal(1.0, (1 + ratio.square()).sqrt()).log_prob(2.5 * ratio)
    prior = priors(model)["covar_module.terms.0.basis.rho_prior"]
    actual = prior.log_prob((2.5 * ratio).reshape(prior.loc.shape))
    torch.testing.assert_close(actual.flatten(), expected)
    noise = priors(model)["likelihood.noise_covar.noise_prior"]
    initial = model.likelihood.noise.detach()  # a hundredth of the typical size
    torch.testing.assert_close(noise.loc, (0.1 * initial).log())
    assert (noise.scale == 4).all()


def test_a_users_priors_and_fixed_parameters_are_left_alone(data):
    X, Y = data()
    own = GammaPrior(3.0, 6.0)
    kernel = ScaleKernel(RBFKernel(ard_num_dims=2, lengthscale_prior=own))
    model = CKA(X, Y, center=0.0, physics=lambda X: crude(X)[..., :1], rho_covar_module=kernel)
    model.terms[1].kernel.raw_outputscale.requires_grad_(False)
    register_priors(model)
    assert kernel.base_kernel.lengthscale_prior is own
    assert not hasattr(model.terms[1].kernel, "outputscale_prior")
    before = priors(model)
    register_priors(model)
    assert priors(model) == before


@pytest.mark.parametrize("kind", ["CKA", "AR1", "RRA", "ScaleGP"])
def test_objective_is_gpytorchs_log_posterior(build, data, shuffle, kind, num_outputs):
    model = build(kind, *data(num_outputs=num_outputs))
    register_priors(model)
    shuffle(model)
    objective = Target(model)
    model.train()
    inputs = model.train_inputs[0]
    likelihood = model.likelihood(model(inputs), model.transform_inputs(inputs))
    expected = likelihood.log_prob(model.train_targets).sum() + sum(
        prior.log_prob(read(module)).sum() for _, module, prior, read, _ in model.named_priors()
    )
    value = objective(objective.parameters.current())
    torch.testing.assert_close(-value.sum(), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("prior", [None, GammaPrior(3.0, 6.0), LogNormalPrior(0.1, 0.7)])
def test_potential_has_the_jacobian_of_the_logarithm(data, prior):
    X, Y = data()
    kernel = ScaleKernel(RBFKernel(ard_num_dims=2, lengthscale_prior=prior))
    model = CKA(X, Y, center=0.0, physics=lambda X: crude(X)[..., :1], rho_covar_module=kernel)
    register_priors(model)
    objective = Target(model)
    of_logs = LogPosterior(model)
    of_logs._trend = None
    potential = of_logs.value_and_gradient
    settings = objective.parameters.current() + 0.1
    value, gradient = potential(settings)
    # All parameters are positive and sampled as logarithms.
    torch.testing.assert_close(value, objective(settings) - settings.sum(-1))
    step = 1e-5 * torch.eye(settings.shape[-1], dtype=torch.float64).unsqueeze(-2)
    numeric = (potential(settings + step)[0] - potential(settings - step)[0]) / 2e-5
    torch.testing.assert_close(gradient[0, 0], numeric[:, 0], rtol=1e-5, atol=1e-5)


def test_two_priors_of_one_parameter_both_count(data):
    X, Y = data()
    model = CKA(X, Y, physics=lambda X: crude(X)[..., :1])
    kernel = model.terms[0].kernel
    values = []
    for i, prior in enumerate([LogNormalPrior(0.1, 0.7), LogNormalPrior(-2.0, 0.3)]):
        kernel.register_prior(f"prior_{i}", prior, "outputscale")
        target = Target(model)
        values.append(target(target.parameters.current()))
    added = LogNormalPrior(-2.0, 0.3).log_prob(kernel.outputscale.detach())
    torch.testing.assert_close(values[1] - values[0], -added.reshape(1, 1))
