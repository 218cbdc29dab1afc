"""Every kernel of GPyTorch is that of rho or delta, with its priors."""

from copy import deepcopy

import gpytorch.kernels as kernels
import pytest
import torch
from gpytorch.constraints import Interval
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.priors import GammaPrior, LogNormalPrior

from gpadjust.core import CKA, LogNormal, Noise, OfGPyTorch, fit

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
NOT_ALONE = {
    "Kernel": "the base of all",
    "keops": "needs another library",
    "MultiDeviceKernel": "needs several GPUs",
    "GridKernel": "of the points of a grid, only",
    "MultitaskKernel": "of several outputs at each point",
    "LCMKernel": "of several outputs at each point",
    "PolynomialKernelGrad": "of values and derivatives at each point",
    "RBFKernelGrad": "of values and derivatives at each point",
    "RBFKernelGradGrad": "of values and derivatives at each point",
    "Matern52KernelGrad": "of values and derivatives at each point",
}


def test_all_kernels_are_here():
    made = {type(part).__name__ for make in KERNELS.values() for part in make().modules()}
    assert {*kernels.__all__} <= made | {*NOT_ALONE}


def wave(X):
    return torch.sin(6 * X[..., :1])


@pytest.fixture
def data(uniform):
    X = uniform(9, 2, low=-0.6, high=0.6)
    return X, 1.5 * wave(X) + X[:, 1:].square() + 0.05 * uniform(9, 1, seed=1)


@pytest.mark.filterwarnings("ignore:Sparse invariant checks")  # of an interpolated kernel
@pytest.mark.parametrize("name", KERNELS)
def test_covariance_and_gradient(data, name):
    X, Y = data
    if name == "hamming":
        first = (X[:, :1] > 0).double()
        X = torch.cat([first, 1 - first], -1)  # one letter of two
    noise = Noise(priors=[LogNormal(1e-3, 55.0)])  # differences round off where it is lower
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
    for i in range(u.shape[-1]):
        step = torch.zeros_like(u)
        step[..., i] = 1e-5
        slope = (model.log_likelihood(u + step)[0] - model.log_likelihood(u - step)[0]) / 2e-5
        torch.testing.assert_close(gradient[..., i], slope, rtol=3e-4, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cylindrical", "sum", "product", "scale"])
def test_fit(data, name):
    X, Y = data
    model = CKA(
        X, Y, physics=wave, rho_covar_module=KERNELS[name](), delta_covar_module=KERNELS[name]()
    )
    for method in ("map", "bayes"):
        fit(model, method)
        assert model.predict(X).variance.isfinite().all()


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


def test_what_is_refused():
    with pytest.raises(TypeError, match="found 'rbf'"):
        OfGPyTorch("rbf")
    with pytest.raises(ValueError, match="without batch shape"):
        OfGPyTorch(kernels.RBFKernel(batch_shape=torch.Size([2])))
