"""CKA against the paper's equations, in the user's units."""

import pytest
import torch
from botorch.models.transforms import Normalize, Standardize

from gpadjust import CKA

QUANTITIES = ["posterior", "rho", "delta"]


def in_users_units(model, rbf, output=None, ranges=1.0):
    """Kernels and noise of one output of a CKA, in the units of the user's X and Y."""
    scale = 1.0
    if hasattr(model, "outcome_transform"):
        scale = model.outcome_transform.stdvs.detach().reshape(-1)[output or 0]
    pick = (lambda t: t.detach()[output]) if output is not None else (lambda t: t.detach())
    rho, delta = (term.kernel for term in model.terms)
    noise = pick(model.likelihood.noise).squeeze(-1) * scale**2
    return {
        "k_rho": rbf(pick(rho.base_kernel.lengthscale) * ranges, pick(rho.outputscale)),
        "k_delta": rbf(
            pick(delta.base_kernel.lengthscale) * ranges, pick(delta.outputscale) * scale**2
        ),
        "noise": noise,
    }


def problem(uniform, d, scale, seed):
    """Random inputs in a box of random size, and a physics and truth of a given scale."""
    weights = uniform(3, d, low=-2, high=2, seed=seed + 100)
    sides = uniform(d, low=0.5, high=3.0, seed=seed + 200)
    X = uniform(6 + 2 * d, d, seed=seed) * sides
    Z = uniform(7, d, low=-0.3, high=1.3, seed=seed + 300) * sides

    def physics(X):
        return scale * ((X @ weights[0]).sin() + 0.5 * X @ weights[1] + 0.3)

    Y = 1.3 * physics(X) + scale * 0.4 * (X @ weights[2]).cos()
    return X, Y.unsqueeze(-1), Z, physics


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("center", [0.0, "mean", 0.7])
@pytest.mark.parametrize(("d", "scale"), [(1, 1.0), (2, 1e4), (3, 1e-4), (5, 1.0)])
def test_mean_and_covariance(uniform, shuffle, dense, rbf, close, d, scale, center, quantity):
    for seed in range(3):
        X, Y, Z, physics = problem(uniform, d, scale, seed)
        c = center * scale if isinstance(center, float) else center
        model = shuffle(CKA(X, Y, physics=physics, center=c), seed)
        c = physics(X).mean() if center == "mean" else c
        expected = dense(X, Y[:, 0], physics, center=c, **in_users_units(model, rbf))
        mean, covariance = getattr(expected, quantity)(Z)
        posterior = getattr(model, quantity)(Z)
        close(posterior.mean.detach().squeeze(-1), mean)
        close(posterior.distribution.covariance_matrix.detach(), covariance)
        close(posterior.variance.detach().squeeze(-1), covariance.diagonal())


@pytest.mark.parametrize(
    ("scale", "quantity", "transform"),
    [
        (1.0, "posterior", "default"),
        (1e4, "posterior", "default"),
        (1e-4, "posterior", "default"),
        (1.0, "delta", "default"),
        (1e-4, "delta", "default"),
        (1.0, "posterior", "standardize"),
        (1e-4, "posterior", "standardize"),
    ],
)
def test_variances_that_are_small(dense, rbf, close, scale, quantity, transform):
    X = torch.linspace(0, 1, 30, dtype=torch.float64).unsqueeze(-1)
    options = {"outcome_transform": Standardize(1)} if transform == "standardize" else {}
    Y = scale * (1 + X + 0.1 * (5 * X).sin())
    model = CKA(X, Y, physics=lambda X: scale * (1 + X), **options).eval()
    with torch.no_grad():
        for term, outputscale in zip(model.terms, (1e-4, 1e-3), strict=True):
            term.kernel.outputscale = outputscale
        model.likelihood.noise = 1e-3
    formula = in_users_units(model, rbf)
    expected = dense(X, Y[:, 0], lambda X: scale * (1 + X[:, 0]), **formula)
    _, covariance = getattr(expected, quantity)(X)
    close(getattr(model, quantity)(X).variance.detach().squeeze(-1), covariance.diagonal(), 1e-6)


def test_observation_noise_is_added(uniform, shuffle, dense, rbf, close):
    X, Y, Z, physics = problem(uniform, 2, 10.0, 0)
    model = shuffle(CKA(X, Y, physics=physics))
    formula = dense(X, Y[:, 0], physics, **in_users_units(model, rbf))
    mean, covariance = formula.posterior(Z)
    posterior = model.posterior(Z, observation_noise=True)
    close(posterior.mean.detach().squeeze(-1), mean)
    close(
        posterior.distribution.covariance_matrix.detach(),
        covariance + formula.noise * torch.eye(len(Z), dtype=torch.float64),
    )


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_known_noise(uniform, shuffle, dense, rbf, close, quantity):
    X, Y, Z, physics = problem(uniform, 2, 3.0, 1)
    Yvar = uniform(*Y.shape, low=0.01, high=0.3, seed=9)
    model = shuffle(CKA(X, Y, Yvar, physics=physics))
    formula = in_users_units(model, rbf) | {"noise": Yvar[:, 0]}
    mean, covariance = getattr(dense(X, Y[:, 0], physics, **formula), quantity)(Z)
    posterior = getattr(model, quantity)(Z)
    close(posterior.mean.detach().squeeze(-1), mean)
    close(posterior.distribution.covariance_matrix.detach(), covariance)


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("center", [0.0, "mean"])
@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("transform", ["default", "none", "standardize"])
def test_several_outputs_and_transforms(
    data, uniform, shuffle, dense, rbf, close, crude_physics, transform, normalize, center, quantity
):
    X, Y = data(num_outputs=2)
    Z = uniform(5, 2, high=2.0, seed=5)
    options = {"none": {"outcome_transform": None}, "standardize": {}, "default": {}}[transform]
    if transform == "standardize":
        options = {"outcome_transform": Standardize(2)}
    if normalize:
        options["input_transform"] = Normalize(2)
    model = shuffle(CKA(X, Y, physics=crude_physics, center=center, **options))
    ranges = X.amax(0) - X.amin(0) if normalize else 1.0
    posterior = getattr(model, quantity)(Z)
    for j in range(2):

        def physics(X, j=j):
            return crude_physics(X)[:, j]

        formula = in_users_units(model, rbf, output=j, ranges=ranges)
        c = physics(X).mean() if center == "mean" else 0.0
        mean, covariance = getattr(dense(X, Y[:, j], physics, center=c, **formula), quantity)(Z)
        close(posterior.mean[:, j].detach(), mean)
        close(posterior.variance[:, j].detach(), covariance.diagonal())


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("num_outputs", [1, 2])
def test_a_batch_of_data_sets_is_as_many_models(
    data, build, uniform, shuffle, close, num_outputs, quantity
):
    X, Y = data(batch_shape=(3,), num_outputs=num_outputs)
    Z = uniform(5, 2, high=2.0, seed=5)
    batch = shuffle(build("CKA", X, Y, center="mean"))
    posterior = getattr(batch, quantity)(Z)
    assert posterior.mean.shape == (3, 5, num_outputs)
    for i in range(3):
        single = build("CKA", X[i], Y[i], center="mean")
        values = {n: p[i] for n, p in batch.named_parameters()}
        with torch.no_grad():
            for name, parameter in single.named_parameters():
                parameter.copy_(values[name])
        expected = getattr(single.eval(), quantity)(Z)
        close(posterior.mean[i].detach(), expected.mean.detach())
        close(posterior.variance[i].detach(), expected.variance.detach())


def test_rho_times_physics_plus_delta_is_the_models_mean(
    data, build, uniform, shuffle, close, crude_physics, num_outputs
):
    X, Y = data(num_outputs=num_outputs)
    Z = uniform(6, 2, low=-1.0, high=3.0, seed=4)
    for center in (0.0, "mean"):
        model = shuffle(build("CKA", X, Y, center=center))
        f_p = crude_physics(Z)[:, :num_outputs]
        sum_of_parts = model.rho(Z).mean * f_p + model.delta(Z).mean
        close(sum_of_parts.detach(), model.posterior(Z).mean.detach())


def test_nlml(uniform, shuffle, dense, rbf):
    X, Y, _, physics = problem(uniform, 2, 10.0, 0)
    model = shuffle(CKA(X, Y, physics=physics))
    formula = dense(X, Y[:, 0], physics, **in_users_units(model, rbf))
    model.train()
    output = model(*model.train_inputs)
    log_density = model.likelihood(output).log_prob(model.train_targets)
    jacobian = len(Y) * model.outcome_transform.stdvs.log().item()
    assert -log_density.item() + jacobian == pytest.approx(formula.nlml().item(), rel=1e-9)
