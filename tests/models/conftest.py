"""The paper's formulas in plain linear algebra."""

import pytest
import torch


def rbf_kernel(lengthscale, variance):
    """The squared exponential covariance as a function of two inputs."""

    def k(A, B):
        distance = ((A[:, None, :] - B[None, :, :]) / lengthscale).square().sum(-1)
        return variance * torch.exp(-distance / 2)

    return k


def ones(X):
    return torch.ones_like(X[:, 0])


class Dense:
    """Section 2.1.2 of the paper for one output of a model, in the user's units.

    f = sum rho_i f_i + delta, with RBF kernels and noise of the model, and with centers c_i in the
    kernels: a priori rho_i is independent of delta + sum c_i rho_i, which has the kernel of delta.
    Where a term's prior mean has a variance, that adds to its kernel.

    Args:
        model: The model.
        X: Inputs.
        Y: Targets, all columns.
        physics: Functions of inputs that make as many columns.
        output: Which of the columns.
        center: The number c, or "mean".
        noise: Known variances, or None for the model's.
        ranges: What the inputs' transform divides them by.
        means: The prior means of the rhos and of delta. Default: the model's.
        vague: The variance of unknown means. Default: the model's.
    """

    def __init__(
        self,
        model,
        X,
        Y,
        *physics,
        output=0,
        center=0.0,
        noise=None,
        ranges=1.0,
        means=None,
        vague=None,
    ):
        m = Y.shape[-1]

        def pick(values):
            return values.detach().reshape(m, -1)[output]

        transform = getattr(model, "outcome_transform", None)
        scale = 1.0 if transform is None else transform.stdvs.flatten()[output]
        columns = [lambda X, f=f: f(X).reshape(len(X), m)[:, output] for f in physics]
        centers = [column(X).mean() if center == "mean" else center for column in columns]
        means = means or [model.term_mean(term.name, output) for term in model.terms]
        self.physics, self.means = [*columns, ones], means
        self.bases = [lambda X, f=f, c=c: f(X) - c for f, c in zip(columns, centers, strict=True)]
        self.bases, self.centers = [*self.bases, ones], [*centers, -1.0]
        self.kernels = []
        for term in model.terms:
            unit = 1.0 if term.name.startswith("rho") else scale**2
            base, kappa = term.kernel.base_kernel, pick(term.mean_variance) * unit
            kappa = vague if vague and term.learns_mean else kappa
            k = rbf_kernel(pick(base.lengthscale) * ranges, pick(term.kernel.outputscale) * unit)
            self.kernels.append(lambda A, B, k=k, kappa=kappa: k(A, B) + kappa)
        known = noise is not None
        self.noise = noise[:, output] if known else pick(model.likelihood.noise) * scale**2
        self.X, eye = X, torch.eye(len(X), dtype=X.dtype)
        self.K = self.cross(self.bases, X, self.bases, X) + self.noise * eye
        self.residual = Y[:, output] - self.mean(X)

    def mean(self, X):
        return sum(mean * f(X) for mean, f in zip(self.means, self.physics, strict=True))

    def cross(self, left, A, right, B):
        """The prior covariance of two sums of terms, for the weights of each."""
        parts = zip(left, self.kernels, right, strict=True)
        return sum(a(A)[:, None] * k(A, B) * b(B)[None, :] for a, k, b in parts if a and b)

    def condition(self, weights, mean, Z):
        """Mean and covariance of a sum of terms at Z."""
        cross = self.cross(weights, Z, self.bases, self.X)
        mean = mean + cross @ torch.linalg.solve(self.K, self.residual)
        prior = self.cross(weights, Z, weights, Z)
        return mean, prior - cross @ torch.linalg.solve(self.K, cross.mT)

    def posterior(self, Z):
        return self.condition(self.bases, self.mean(Z), Z)

    def rho(self, Z, i=0):
        weights = [ones if j == i else None for j in range(len(self.bases))]
        return self.condition(weights, self.means[i], Z)

    def delta(self, Z):
        weights = [lambda X, c=c: -c * ones(X) for c in self.centers]
        return self.condition(weights, self.means[-1], Z)

    def nlml(self):
        n, inverse = len(self.residual), torch.linalg.solve(self.K, self.residual)
        constant = n * torch.log(torch.tensor(2 * torch.pi, dtype=torch.float64))
        return 0.5 * (self.residual @ inverse + torch.logdet(self.K) + constant)


@pytest.fixture
def dense():
    return Dense


@pytest.fixture
def rbf():
    """`rbf(lengthscale, variance)` is the squared exponential covariance as a function."""
    return rbf_kernel


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
