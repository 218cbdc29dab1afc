"""Kernels, terms, choices and noises of users, and every kernel of GPyTorch with its priors."""

from copy import deepcopy

import gpytorch.kernels as kernels
import pytest
import torch
from botorch.models.transforms import Normalize
from gpytorch.constraints import Interval
from gpytorch.kernels import RBFKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.priors import GammaPrior, LogNormalPrior, UniformPrior

from gpadjust import core
from gpadjust.core import CKA, GP, Kernel, Noise, Stationary, Term, ZeroMeanGP, fit
from tests.systems import same, slopes, wave


@pytest.fixture
def data(uniform):
    X = uniform(12, 2)
    return X, 1.4 * wave(X) + X[:, 1:].square() + 0.05 * uniform(12, 1, low=-1.0, seed=1)


@pytest.mark.parametrize("probabilities", [(0.3, 0.7), (0.1, 0.8, 0.1), (0.9, 0.1)])
def test_choices_of_any_probability(data, probabilities):
    """The first choice contains u = 0, each can be asked for, and the prior draws them so."""
    zeros = [(), ("g.process",), ("g.process", "f.process")]
    pairs = zip(probabilities, zeros, strict=False)
    choices = [core.Choice(f"{k}", p, names) for k, (p, names) in enumerate(pairs)]
    terms = [Term("f", Stationary()), Term("g", Stationary(core.MATERN32))]
    table = GP(*data, terms=terms, choices=choices).table
    u = torch.randn(4000, 1, table.size, dtype=torch.float64)
    drawn = table.chosen(table.values(u)).flatten()
    assert table.chosen(table.values(0 * u[:1])).item() == 0
    for k, p in enumerate(probabilities):
        of_k = table.values(table.with_choice(u[:3], k))
        assert (table.chosen(of_k) == k).all()
        assert (drawn == k).double().mean().item() == pytest.approx(p, abs=0.03)


def test_further_terms(data, uniform):
    """Terms are independent of their order, and the formula as it is has none of them."""
    X, Y = data
    g = Term("g", ScaleKernel(RBFKernel(active_dims=[1])))
    model = CKA(X, Y, physics=wave, extra_terms=[g])
    assert "g.process" in model.table.choices[1].zeros
    Z = uniform(5, 2, seed=3)
    parts = model.rho(Z).mean * wave(Z) + model.delta(Z).mean + model.term("g", Z).mean
    torch.testing.assert_close(parts, model.predict(Z).mean)
    # g varies with its input alone, also if it is listed before delta.
    rho, delta = model.terms[:2]
    first = GP(X, Y, terms=[rho, g, delta], physics=[wave])
    low, high = first.term("g", torch.tensor([[0.1, 0.5], [0.9, 0.5]]).double()).mean
    torch.testing.assert_close(low, high)


class Brownian(Kernel):
    """min(x, x') of the first input."""

    def rows(self, x, num_outputs):
        return [core.Row.positive("scale", x.new_ones(num_outputs, 1), 3.0)]

    def covariance(self, own, x, other=None):
        other = x if other is None else other
        least = torch.minimum(x[..., :1], other[..., :1].mT)
        return own["scale"].unsqueeze(-1) * least


def test_a_kernel_of_ones_own(data, uniform):
    X, Y = data
    model = CKA(X, Y, physics=wave, delta_covar_module=Brownian())
    Z = uniform(50, 2, seed=3)
    joint = model.posterior(Z)
    same(model.predict(Z), (joint.mean, joint.variance), rtol=1e-6, atol=1e-9)
    batch = model.predict(Z.expand(3, 50, 2))
    torch.testing.assert_close(batch.variance[1], joint.variance, rtol=1e-6, atol=1e-9)
    u = model.u.detach() + 0.1
    expected = slopes(lambda u: model.log_likelihood(u)[0], u)
    torch.testing.assert_close(model.log_likelihood(u)[1], expected, rtol=1e-5, atol=1e-5)


def test_a_prior_with_ends(data):
    kernel = RBFKernel(lengthscale_prior=UniformPrior(0.1, 2.0))
    model = CKA(*data, physics=wave, delta_covar_module=ScaleKernel(kernel))
    fit(model)
    lengths = model.table.values(model.draws)["delta.kernel.base_kernel.raw_lengthscale"]
    assert ((lengths > 0.1) & (lengths < 2.0)).all()


class Growing(Noise):
    """v_1 + v_2 x_1^2."""

    def __init__(self):
        super().__init__(("constant", "growing"))

    def shares(self, places):
        x = places.X[..., 0]
        return torch.stack([torch.ones_like(x), x.square()], -1)


def test_a_noise_reads_inputs_as_the_user_gave_them(data):
    X, Y = data
    predicted = []
    for options in ({}, {"input_transform": Normalize(2)}):
        model = ZeroMeanGP(3 * X, Y, noise=Growing(), **options)
        noise = model.predict(3 * X, True).variance - model.predict(3 * X).variance
        v = [model.values[f"noise.{name}"].item() for name in ("constant", "growing")]
        expected = (v[0] + v[1] * 9 * X[:, :1].square()) * model.unit.square()
        torch.testing.assert_close(noise.detach(), expected.detach(), rtol=1e-6, atol=1e-8)
        predicted.append(noise.detach())
    torch.testing.assert_close(*predicted)


KERNELS = {
    "rbf": lambda: kernels.RBFKernel(ard_num_dims=2),
    "matern": lambda: kernels.MaternKernel(nu=1.5),
    "rq": lambda: kernels.RQKernel(),
    "periodic": lambda: kernels.PeriodicKernel(),
    "cosine": lambda: kernels.CosineKernel(active_dims=[0]),
    "linear": lambda: kernels.LinearKernel(),
    "polynomial": lambda: kernels.PolynomialKernel(power=2),
    "constant": lambda: kernels.ConstantKernel(),
    "cylindrical": lambda: kernels.CylindricalKernel(3, kernels.MaternKernel(nu=2.5)),
    "spectral mixture": lambda: kernels.SpectralMixtureKernel(num_mixtures=2, ard_num_dims=2),
    "polynomial of pieces": lambda: kernels.PiecewisePolynomialKernel(q=2),
    "arc": lambda: kernels.ArcKernel(kernels.MaternKernel(nu=2.5), ard_num_dims=2),
    "hamming": lambda: kernels.HammingIMQKernel(vocab_size=2),
    "random features": lambda: kernels.RFFKernel(num_samples=8, num_dims=2),
    "additive structure": lambda: kernels.NewtonGirardAdditiveKernel(kernels.RBFKernel(), 2, 1),
    "scale": lambda: kernels.ScaleKernel(kernels.RBFKernel(), outputscale_prior=GammaPrior(2, 2)),
    "sum": lambda: kernels.ConstantKernel() + kernels.PolynomialKernel(power=1),
    "product": lambda: kernels.LinearKernel() * kernels.ScaleKernel(kernels.PeriodicKernel()),
    "one column": lambda: (
        kernels.RBFKernel(active_dims=[1]) * kernels.LinearKernel(active_dims=[0])
    ),
    "interval": lambda: kernels.RBFKernel(lengthscale_constraint=Interval(0.1, 1.0)),
    "sum over columns": lambda: kernels.AdditiveStructureKernel(kernels.RBFKernel(), 2),
    "product over columns": lambda: kernels.ProductStructureKernel(kernels.RBFKernel(), 2),
    "spectral delta": lambda: kernels.SpectralDeltaKernel(2, num_deltas=16),
    "interpolated": lambda: kernels.GridInterpolationKernel(
        kernels.RBFKernel(), grid_size=8, num_dims=2, grid_bounds=((-1, 1), (-1, 1))
    ),
    "inducing points": lambda: kernels.InducingPointKernel(
        kernels.RBFKernel(), torch.rand(4, 2).double(), GaussianLikelihood()
    ),
    "distributions": lambda: kernels.DistributionalInputKernel(
        lambda a, b: torch.cdist(a, b).square()
    ),
    "divergences": lambda: kernels.GaussianSymmetrizedKLKernel(),
    "index": lambda: kernels.RBFKernel(active_dims=[0]) * kernels.IndexKernel(2, active_dims=[1]),
}
# The base, and kernels of KeOps, several GPUs, a grid, several outputs, or derivatives.
NOT_ALONE = {"Kernel", "keops", "MultiDeviceKernel", "GridKernel", "MultitaskKernel", "LCMKernel"}
NOT_ALONE |= {"PolynomialKernelGrad", "RBFKernelGrad", "RBFKernelGradGrad", "Matern52KernelGrad"}


def test_all_kernels_are_here():
    made = {type(part).__name__ for make in KERNELS.values() for part in make().modules()}
    assert {*kernels.__all__} <= made | NOT_ALONE


@pytest.fixture
def centered(uniform):
    X = uniform(9, 2, low=-0.6, high=0.6)
    return X, 1.5 * wave(X) + X[:, 1:].square() + 0.05 * uniform(9, 1, seed=1)


@pytest.mark.filterwarnings("ignore:Sparse invariant checks")  # of an interpolated kernel
@pytest.mark.parametrize("name", KERNELS)
def test_covariance_and_gradient(centered, name):
    X, Y = centered
    if name == "hamming":
        first = (X[:, :1] > 0).double()
        X = torch.cat([first, 1 - first], -1)  # one letter of two
    noise = Noise(priors=[core.LogNormal(1e-3, 55.0)])  # differences round off where it is lower
    delta = KERNELS[name]()
    model = CKA(X, Y, physics=wave, delta_covar_module=delta, noise=noise, nested=False)
    term = model.terms[1]
    own = model.evaluate(X).own(term)
    with torch.no_grad():
        K = term.kernel.covariance(own, X.expand(1, 1, 9, 2)).squeeze()
        kernel = deepcopy(term.kernel.kernel)
        for key, raw, constraint in kernel.named_parameters_and_constraints():
            value = own[key].reshape(raw.shape)
            raw.copy_(value if constraint is None else constraint.inverse_transform(value))
        torch.testing.assert_close(K, kernel(X).to_dense(), rtol=1e-8, atol=1e-10)
    u = model.u.detach() + 0.1 * torch.randn(3, *model.u.shape[1:], dtype=torch.float64)
    value, gradient = model.log_likelihood(u)
    assert value.isfinite().all()
    if name == "additive structure":  # whose derivatives GPyTorch itself has wrong
        return
    expected = slopes(lambda u: model.log_likelihood(u, False)[0], u)
    torch.testing.assert_close(gradient, expected, rtol=3e-4, atol=1e-4)


def test_a_prior_is_that_of_the_kernel():
    """The density of coordinates is that of the parameter by its prior."""
    prior = LogNormalPrior(0.5, 0.7)
    kernel = kernels.RBFKernel(lengthscale_prior=prior).double()
    X = torch.rand(5, 1, dtype=torch.float64)
    model = CKA(X, X, physics=wave, delta_covar_module=kernel, nested=False)
    row = next(row for row in model.table.own if row.log_density is not None)
    u = torch.linspace(-2, 2, 9, dtype=torch.float64).reshape(9, 1, 1)
    coordinates = torch.zeros(9, 1, model.table.size, dtype=torch.float64)
    names = [r.name for r in model.table.own for _ in range(r.location.shape[-1])]
    coordinates[..., names.index(row.name)] = u[..., 0]
    ratio = model.table.log_prior_ratio(coordinates).flatten()
    theta = row.value(u).flatten()
    # p(u) = p(theta) dtheta / du, with log theta = a + b u
    density = prior.log_prob(theta) + (theta * row.scale).log()
    standard = torch.distributions.Normal(0.0, 1.0).log_prob(u.flatten())
    torch.testing.assert_close(ratio, density - standard, rtol=1e-6, atol=1e-6)
