"""The models under test, and the paper's formulas in plain linear algebra."""

import pytest
import torch

from gpadjust import AR1, CKA, RRA, BiasGP, PhysicsMeanGP, ScaleGP, ZeroMeanGP

_CLASSES = {
    "ZeroMeanGP": ZeroMeanGP,
    "PhysicsMeanGP": PhysicsMeanGP,
    "BiasGP": BiasGP,
    "ScaleGP": ScaleGP,
    "CKA": CKA,
    "AR1": AR1,
    "RRA": RRA,
    "RRA-paper": RRA,
}


def crude(X):
    """Two outputs of two inputs, neither of them near zero on [0, 2]^2."""
    return torch.stack([2 + (3 * X[..., 0]).sin() + X[..., 1], 4 + (2 * X[..., 1]).cos()], dim=-1)


def truth(X):
    bias = torch.stack([X[..., 1].square(), X[..., 0].exp()], dim=-1) / 4
    return crude(X) * (1.2 + 0.2 * X[..., :1]) + bias


def _name(kind):
    # BiasGP is a PhysicsMeanGP, and is tested in its place in the quick run.
    return pytest.param(kind, marks=pytest.mark.slow if kind == "PhysicsMeanGP" else ())


@pytest.fixture(params=[_name(kind) for kind in _CLASSES])
def kind(request):
    """The name of each model, for `build`."""
    return request.param


_QUICK = ["CKA", "AR1", "RRA", "RRA-paper"]


@pytest.fixture(
    params=[pytest.param(k, marks=() if k in _QUICK else pytest.mark.slow) for k in _CLASSES]
)
def costly_kind(request):
    """As `kind`, for what takes long: the baselines are left to the slow run."""
    return request.param


@pytest.fixture(params=[1, 2], ids=["1-output", "2-outputs"])
def num_outputs(request):
    return request.param


@pytest.fixture
def data(uniform):
    """Makes inputs on [0, 2]^2 and targets: `data(batch_shape=(), n=9, num_outputs=1)`."""

    def make(batch_shape=(), n=9, num_outputs=1, seed=0):
        X = uniform(*batch_shape, n, 2, high=2.0, seed=seed)
        return X, truth(X)[..., :num_outputs]

    return make


@pytest.fixture
def build():
    """Builds a model by its name, with the crude physics for as many outputs as Y has."""

    def build(kind, X, Y, Yvar=None, **options):
        m = Y.shape[-1]
        if kind != "ZeroMeanGP":
            options.setdefault("physics", lambda X: crude(X)[..., :m])
        if kind == "AR1":
            options.setdefault("num_low", 12)
            options.setdefault("bounds", torch.tensor([[0.0] * X.shape[-1], [2.0] * X.shape[-1]]))
        if kind.startswith("RRA"):
            options.setdefault("num_features", 24)
        if kind == "RRA-paper":
            options["prior"] = "paper"
        return _CLASSES[kind](X, Y, Yvar, **options)

    return build


@pytest.fixture
def crude_physics():
    return crude


class Dense:
    """Section 2.1.2 of the paper for one output, with kernels given as functions of two inputs.

    With f_p centred at c in the kernel, the prior covariance of rho f_p + delta is
    (f_p - c) k_rho (f_p' - c) + k_delta, so that delta's own kernel is k_delta + c^2 k_rho,
    and its covariance with rho is -c k_rho.
    """

    def __init__(self, X, y, physics, k_rho, k_delta, noise, center=0.0):
        self.X, self.y, self.physics = X, y, physics
        self.k_rho, self.k_delta, self.c = k_rho, k_delta, center
        self.noise = noise
        eye = torch.eye(len(y), dtype=y.dtype)
        self.K = self.prior(X, X) + noise * eye
        self.weights = torch.linalg.solve(self.K, y - physics(X))

    def prior(self, A, B):
        f_a, f_b = self.physics(A) - self.c, self.physics(B) - self.c
        return f_a[:, None] * self.k_rho(A, B) * f_b[None, :] + self.k_delta(A, B)

    def condition(self, prior_mean, prior, cross):
        """`cross` is the covariance of the quantity with the observations."""
        mean = prior_mean + cross @ self.weights
        return mean, prior - cross @ torch.linalg.solve(self.K, cross.mT)

    def posterior(self, Z):
        return self.condition(self.physics(Z), self.prior(Z, Z), self.prior(Z, self.X))

    def rho(self, Z):
        cross = self.k_rho(Z, self.X) * (self.physics(self.X) - self.c)
        return self.condition(1.0, self.k_rho(Z, Z), cross)

    def delta(self, Z):
        cross = self.k_delta(Z, self.X) - self.c * self.k_rho(Z, self.X) * (
            self.physics(self.X) - self.c
        )
        return self.condition(0.0, self.k_delta(Z, Z) + self.c**2 * self.k_rho(Z, Z), cross)

    def nlml(self):
        residual = self.y - self.physics(self.X)
        n = len(residual)
        constant = n * torch.log(torch.tensor(2 * torch.pi, dtype=residual.dtype))
        return 0.5 * (residual @ self.weights + torch.logdet(self.K) + constant)


@pytest.fixture
def dense():
    return Dense


@pytest.fixture
def rbf():
    """`rbf(lengthscale, variance)` is the squared exponential covariance as a function."""

    def make(lengthscale, variance):
        def k(A, B):
            distance = ((A[:, None, :] - B[None, :, :]) / lengthscale).square().sum(-1)
            return variance * torch.exp(-distance / 2)

        return k

    return make


@pytest.fixture
def close():
    """Asserts equality to 1e-8 of the largest number expected."""

    def close(actual, expected, tolerance=1e-8):
        assert actual.shape == expected.shape
        torch.testing.assert_close(
            actual, expected, rtol=tolerance, atol=tolerance * expected.abs().max().item()
        )

    return close
