"""RRA as Bayesian linear regression."""

from itertools import product

import pyro
import pytest
import torch
from botorch.models.transforms import Normalize, Standardize
from pyro.infer.autoguide import AutoLaplaceApproximation


@pytest.fixture(autouse=True)
def _clear_pyro():
    pyro.clear_param_store()
    pyro.set_rng_seed(0)


DESIGNS = ["plain", "centerd", "transformed", "known-noise", "learnt mean"]
WITH_PYRO = [("transformed", 2), ("learnt mean", 1), ("known-noise", 2)]


@pytest.fixture(params=DESIGNS)
def rra(request, data, build, num_outputs, shuffle):
    """An RRA with few features."""
    X, Y = data(num_outputs=num_outputs)
    options = {"num_features": 4}
    if request.param == "centerd":
        options["center"] = "mean"
    if request.param == "transformed":
        options |= {"input_transform": Normalize(2), "outcome_transform": Standardize(num_outputs)}
    if request.param == "learnt mean":
        options["rho_mean"] = "learn"  # one weight more
    Yvar = torch.full_like(Y, 0.02) if request.param == "known-noise" else None
    model = shuffle(build("RRA", X, Y, Yvar, **options))
    model.terms[0].mean_variance *= 4
    return model


def design_of(model, Z):
    """Functions are affine in the weights: that of none, and a design ``m x q x p``."""
    p, m = model.weights().mean.shape[-1], model.num_outputs
    unit = torch.eye(p, dtype=torch.float64)
    unit = unit if m == 1 else unit.unsqueeze(1).expand(p, m, p)
    zero = model.functions(torch.zeros_like(unit[:1]))(Z)
    return zero, (model.functions(unit)(Z) - zero).permute(2, 1, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rra", "num_outputs"),
    [
        pytest.param(*case, marks=() if case in WITH_PYRO else pytest.mark.slow)
        for case in product(DESIGNS, (1, 2))
    ],
    indirect=True,
)
def test_weights_are_pyros_laplace_approximation(rra):
    guide = AutoLaplaceApproximation(rra.pyro_model)
    optimiser = pyro.optim.PyroLRScheduler(
        torch.optim.lr_scheduler.ExponentialLR,
        {"optimizer": torch.optim.Adam, "optim_args": {"lr": 0.5}, "gamma": 0.99},
    )
    svi = pyro.infer.SVI(rra.pyro_model, guide, optimiser, pyro.infer.Trace_ELBO())
    svi.step()
    weights = rra.weights()
    # Laplace's mode is where the optimiser ends: polish it, so that only the Hessian is judged.
    loc = dict(guide.named_parameters())["loc"]
    mode = torch.optim.LBFGS(
        [loc], max_iter=1000, tolerance_grad=1e-10, line_search_fn="strong_wolfe"
    )

    def closure():
        mode.zero_grad()
        loss = pyro.infer.Trace_ELBO().differentiable_loss(rra.pyro_model, guide)
        loss.backward()
        return loss

    mode.step(closure)
    mode.step(closure)
    laplace = guide.laplace_approximation()
    m = rra.num_outputs
    mean = laplace.loc.detach().reshape(weights.mean.shape)
    covariance = laplace.get_posterior().covariance_matrix.detach()
    scale = weights.variance.sqrt().mean().item()
    torch.testing.assert_close(weights.mean.detach(), mean, rtol=1e-3, atol=1e-3 * scale)
    p = weights.mean.shape[-1]
    expected = torch.block_diag(*weights.covariance_matrix.detach().reshape(m, p, p))
    torch.testing.assert_close(covariance, expected, rtol=1e-6, atol=1e-8 * scale**2)


def test_the_pyro_model_is_the_prior_in_the_users_units(rra, close, uniform):
    Z = uniform(5, 2, high=2.0, seed=3)
    sites = pyro.poutine.trace(rra.pyro_model).get_trace(Z).nodes
    weights, prior_sd = sites["weights"]["value"], sites["weights"]["fn"].base_dist.scale
    m, p = rra.num_outputs, weights.shape[-1]
    assert weights.shape == rra.weights().mean.shape
    assert (sites["weights"]["fn"].base_dist.loc == 0).all()
    values = rra.functions(weights.unsqueeze(0))(Z)[0].mT.reshape(sites["Y"]["value"].shape)
    close(sites["Y"]["fn"].base_dist.loc.detach(), values.detach())
    scale = rra.outcome_transform.stdvs.reshape(m, 1)
    noise = rra.likelihood.noise.reshape(m, -1)[:, :1].sqrt() * scale
    noise_sd = sites["Y"]["fn"].base_dist.scale.reshape(m, -1)
    close(noise_sd.detach(), noise.expand_as(noise_sd).detach())
    # Its marginal variance is that of the Gaussian process.
    _, design = design_of(rra, Z)
    variance = (design * prior_sd.reshape(m, 1, p)).square().sum(-1)
    inputs = rra.transform_inputs(Z).expand(*rra._aug_batch_shape, 5, -1)
    prior = rra.covar_module(inputs).to_dense().diagonal(dim1=-1, dim2=-2).reshape(m, 5)
    close(variance.detach(), (prior * scale**2).detach())


def test_the_pyro_model_has_the_known_noise_of_each_point(data, build):
    X, Y = data()
    Yvar = torch.linspace(0.001, 0.5, len(Y), dtype=torch.float64).unsqueeze(-1)
    model = build("RRA", X, Y, Yvar)
    site = pyro.poutine.trace(model.pyro_model).get_trace().nodes["Y"]
    torch.testing.assert_close(site["fn"].base_dist.scale.square(), Yvar.squeeze(-1))


def test_functions_of_the_weights_have_the_posterior(rra, close, uniform):
    Z = uniform(6, 2, high=2.0, seed=3)
    weights = rra.weights()
    posterior = rra.posterior(Z)
    mean = rra.functions(weights.mean.unsqueeze(0))(Z)[0]
    close(mean.detach(), posterior.mean.detach())
    zero, design = design_of(rra, Z)
    m, _, p = design.shape
    if p > 8:  # the weight of an unknown mean moves rho by its own amount
        close(design[..., 4], rra.physics(Z).mT)
    covariance = weights.covariance_matrix.reshape(m, p, p)
    for j in range(m):
        expected = design[j] @ covariance[j] @ design[j].mT
        close(posterior.variance[:, j].detach(), expected.diagonal().detach())
    close(zero[0].detach(), rra.physics(Z))


def test_evidence_is_that_of_the_weights_marginalised(data, build, shuffle):
    X, Y = data()
    model = shuffle(build("RRA", X, Y, num_features=6))
    scale = model.outcome_transform.stdvs.item()
    zero, (design,) = design_of(model, X)
    s_rho, s_delta = (term.kernel.outputscale for term in model.terms)
    prior = torch.cat([s_rho.expand(6), (s_delta * scale**2).expand(6)])
    noise = model.likelihood.noise * scale**2
    covariance = design @ prior.diag() @ design.mT + noise * torch.eye(len(X), dtype=X.dtype)
    expected = torch.distributions.MultivariateNormal(zero[0, :, 0], covariance).log_prob(Y[:, 0])
    model.train()
    marginal = model.likelihood(model(*model.train_inputs))
    jacobian = len(X) * model.outcome_transform.stdvs.log().item()
    actual = marginal.log_prob(model.train_targets).item() - jacobian
    assert actual == pytest.approx(expected.item(), rel=1e-8)


def test_the_seed_makes_the_features(data, build, uniform):
    X, Y = data()
    Z = uniform(5, 2)
    first, same, other = (build("RRA", X, Y, seed=s).posterior(Z).mean for s in (1, 1, 2))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_rho_and_delta_have_features_of_their_own_which_the_outputs_share(data, build):
    model = build("RRA", *data(num_outputs=2))
    rho, delta = (term.kernel.base_kernel.randn_weights for term in model.terms)
    assert not torch.equal(rho, delta)
    assert torch.equal(rho[0], rho[1])
