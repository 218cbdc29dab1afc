"""The paper's formulas in plain linear algebra."""

import pytest
import torch


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
        size = expected.abs().max().item() if expected.numel() else 0.0
        torch.testing.assert_close(
            actual.detach(), expected.detach(), rtol=tolerance, atol=tolerance * size
        )

    return close


@pytest.fixture
def same(close):
    """Asserts that two models say the same at `Z`: joint, one by one, and of each term."""

    def same(a, b, Z, tolerance=1e-8, outputs=slice(None)):
        assert a.term_names == b.term_names
        p, q = a.predict(Z), b.predict(Z)
        close(p.mean, q.mean[..., outputs], tolerance)
        close(p.variance, q.variance[..., outputs], tolerance)
        for name in (None, *a.term_names):
            p, q = (m.posterior(Z) if name is None else m.term(name, Z) for m in (a, b))
            close(p.mean, q.mean[..., outputs], tolerance)
            close(p.variance, q.variance[..., outputs], tolerance)
            if outputs == slice(None):
                p, q = (r.distribution.covariance_matrix for r in (p, q))
                close(p, q, tolerance)

    return same


@pytest.fixture
def kernel_of():
    """`kernel_of(model, name)` is the kernel of a term."""

    def kernel_of(model, name):
        (kernel,) = (term.kernel for term in model.terms if term.name == name)
        return kernel

    return kernel_of


@pytest.fixture
def rebuild(build):
    """A model on other data with the hyper-parameters and units of the one given."""

    def on(kind, model, X, Y, Yvar=None, **options):
        new = build(kind, X, Y, Yvar, **options)
        own = new.state_dict()
        state = {k: v for k, v in model.state_dict().items() if own[k].shape == v.shape}
        new.load_state_dict({**own, **state})
        return new.eval()

    return on
