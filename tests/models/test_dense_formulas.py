"""CKA against the paper's equations, in the user's units."""

import mpmath as mp
import pytest
import torch
from botorch.models.transforms import Normalize, Standardize

from gpadjust import CKA, RRA
from gpadjust.gp.gaussian import nugget
from tests.systems import crude, line, ripple

QUANTITIES = ["posterior", "rho", "delta"]


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


def agree(model, formula, Z, close, tolerance=1e-8, j=0):
    """Each quantity is what the formulas say."""
    for quantity in QUANTITIES:
        mean, covariance = getattr(formula, quantity)(Z)
        posterior = getattr(model, quantity)(Z)
        close(posterior.mean[:, j], mean, tolerance)
        close(posterior.variance[:, j], covariance.diagonal(), tolerance)
        if posterior.mean.shape[-1] == 1:
            close(posterior.distribution.covariance_matrix, covariance, tolerance)


@pytest.mark.parametrize("center", [0.0, "mean", 0.7])
@pytest.mark.parametrize(("d", "scale"), [(1, 1.0), (2, 1e4), (3, 1e-4), (5, 1.0)])
def test_mean_and_covariance(uniform, shuffle, dense, close, d, scale, center):
    for seed in range(3):
        X, Y, Z, physics = problem(uniform, d, scale, seed)
        c = center * scale if isinstance(center, float) else center
        model = shuffle(CKA(X, Y, physics=physics, center=c), seed)
        agree(model, dense(model, X, Y, physics, center=c), Z, close)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize("options", [{}, {"outcome_transform": Standardize(1)}], ids=["", "std"])
def test_variances_that_are_small(dense, close, scale, options):
    X = line(30)
    Y = scale * (1 + X + 0.1 * (5 * X).sin())

    def physics(X):
        return scale * (1 + X)

    model = CKA(X, Y, physics=physics, center=0.0, **options).eval()
    with torch.no_grad():
        for term, outputscale in zip(model.terms, (1e-4, 1e-3), strict=True):
            term.kernel.outputscale = outputscale
        model.likelihood.noise = 1e-3
    agree(model, dense(model, X, Y, physics), X, close, 1e-6)


def test_noise_known_and_of_observations_and_the_marginal_likelihood(
    uniform, shuffle, dense, close
):
    X, Y, Z, physics = problem(uniform, 2, 10.0, 0)
    model = shuffle(CKA(X, Y, physics=physics, center=0.0))
    formula = dense(model, X, Y, physics)
    mean, covariance = formula.posterior(Z)
    posterior = model.posterior(Z, observation_noise=True)
    close(posterior.mean.squeeze(-1), mean)
    noise = formula.noise * torch.eye(len(Z), dtype=torch.float64)
    close(posterior.distribution.covariance_matrix, covariance + noise)
    model.train()
    log_density = model.likelihood(model(*model.train_inputs)).log_prob(model.train_targets)
    jacobian = len(Y) * model.outcome_transform.stdvs.log().item()
    assert -log_density.item() + jacobian == pytest.approx(formula.nlml().item(), rel=1e-9)
    X, Y, Z, physics = problem(uniform, 2, 3.0, 1)
    Yvar = uniform(*Y.shape, low=0.01, high=0.3, seed=9)
    model = shuffle(CKA(X, Y, Yvar, physics=physics, center=0.0))
    agree(model, dense(model, X, Y, physics, noise=Yvar), Z, close)


@pytest.mark.parametrize("center", [0.0, "mean"])
@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("transform", ["default", "none", "standardize"])
def test_several_outputs_and_transforms(
    data, uniform, shuffle, dense, close, transform, normalize, center
):
    X, Y = data(num_outputs=2)
    options = {"input_transform": Normalize(2)} if normalize else {}
    if transform != "default":
        options["outcome_transform"] = Standardize(2) if transform == "standardize" else None
    model = shuffle(CKA(X, Y, physics=crude, center=center, **options))
    units = {"center": center, "ranges": X.amax(0) - X.amin(0) if normalize else 1.0}
    for j in range(2):
        formula = dense(model, X, Y, crude, output=j, **units)
        agree(model, formula, uniform(5, 2, high=2.0, seed=5), close, j=j)


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
    data, build, uniform, shuffle, close, num_outputs
):
    X, Y = data(num_outputs=num_outputs)
    Z = uniform(6, 2, low=-1.0, high=3.0, seed=4)
    for center in (0.0, "mean"):
        model = shuffle(build("CKA", X, Y, center=center))
        f_p = crude(Z)[:, :num_outputs]
        sum_of_parts = model.rho(Z).mean * f_p + model.delta(Z).mean
        close(sum_of_parts.detach(), model.posterior(Z).mean.detach())


# Variances where there is (next to) no noise, against arithmetic with 60 digits


def covariance(kernel, A, B):
    """The kernel of a term between two lists of inputs, and with itself where A is B."""
    base, scale = kernel.base_kernel, mp.mpf(kernel.outputscale.item())
    length = mp.mpf(base.lengthscale.item())
    if not hasattr(base, "randn_weights"):
        return mp.matrix([[scale * mp.exp(-(((a - b) / length) ** 2) / 2) for b in B] for a in A])
    w = [mp.mpf(v) / length for v in base.randn_weights.flatten().tolist()]
    return mp.matrix([[scale / len(w) * sum(mp.cos(v * (a - b)) for v in w) for b in B] for a in A])


def variances(model, X, Z):
    """Exact posterior variances of f, rho and delta at Z, in the user's units."""
    exact = [[mp.mpf(v) for v in values.flatten().tolist()] for values in (X, Z)]
    x, z = exact
    scale, n = mp.mpf(model.outcome_transform.stdvs.item()), len(x)
    f, g = (mp.diag([mp.mpf(v) / scale for v in ripple(P).flatten().tolist()]) for P in (X, Z))
    rho, delta = (term.kernel for term in model.terms)
    K = f * covariance(rho, x, x) * f + covariance(delta, x, x)
    K += mp.mpf(model.likelihood.noise.item()) * mp.eye(n)
    if type(model) is CKA:
        K += mp.mpf(nugget(n)) * mp.diag([K[i, i] for i in range(n)])
    inverse = mp.inverse(K)
    with_rho, with_delta = covariance(rho, z, x) * f, covariance(delta, z, x)
    k_rho, k_delta = covariance(rho, z, z), covariance(delta, z, z)
    for prior, cross, unit in (
        (g * k_rho * g + k_delta, g * with_rho + with_delta, scale**2),
        (k_rho, with_rho, 1),
        (k_delta, with_delta, scale**2),
    ):
        left = prior - cross * inverse * cross.T
        yield torch.tensor([float(left[i, i] * unit) for i in range(len(z))], dtype=torch.float64)


@pytest.mark.parametrize("length", [0.5, 1.5, 5.0])
@pytest.mark.parametrize("n", [8, 20, pytest.param(40, marks=pytest.mark.slow)])
@pytest.mark.parametrize("cls", [CKA, RRA])
def test_variances(cls, n, length):
    X = line(n)
    Y = 1.5 * ripple(X) + X.square()
    options = {"center": 0.0} | ({"num_features": 40} if cls is RRA else {})
    model = cls(X, Y, physics=ripple, **options).eval()
    noise = model.likelihood.noise_covar
    with torch.no_grad():
        noise.raw_noise.fill_(1.0001 * noise.raw_noise_constraint.lower_bound.log())
        for term in model.terms:
            term.kernel.base_kernel.lengthscale = length
    Z = torch.tensor([[-0.2], [0.013], [0.31], [0.517], [0.99], [1.1]], dtype=torch.float64)
    with torch.no_grad(), mp.workdps(60):
        whole, rho, delta = variances(model, X, Z)
        assert whole.min() < 1e-8 * Y.var()
        for posterior, exact in (
            (model.posterior(Z), whole),
            (model.predict(Z), whole),
            (model.rho(Z), rho),
            (model.delta(Z), delta),
        ):
            torch.testing.assert_close(posterior.variance.squeeze(-1), exact, rtol=0.02, atol=0.0)
        # Half of the data come later; the nugget of the first half is another one.
        half = cls(X[::2], Y[::2], physics=ripple, **options)
        half.load_state_dict(model.state_dict())
        later = half.eval().condition_on_observations(X[1::2], Y[1::2])
        ratio = later.posterior(Z).variance.squeeze(-1) / whole
        assert (ratio.log().abs() < (0.02 if cls is RRA else 1.0)).all()
