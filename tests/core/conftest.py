"""The core's models in plain linear algebra, and numbers for them without a fit."""

import math

import pytest
import torch

LEAST = 1e-11  # what noise has at least, in squared units of the targets


def matern(p):
    polynomials = (lambda t: 1.0, lambda t: 1 + t, lambda t: 1 + t + t.square() / 3)

    def k(squares):
        t = math.sqrt(2 * p + 1) * squares.sqrt()
        return polynomials[p](t) * (-t).exp()

    return k


PROFILES = {
    "rbf": lambda squares: (-squares / 2).exp(),
    **{f"matern{2 * p + 1}/2": matern(p) for p in range(3)},
}


def covariance(kernel, length, A, B):
    """The correlations by a kernel of the core between rows of two inputs."""
    away = (A[:, None, :] - B[None, :, :]) / length
    if hasattr(kernel, "frequencies"):
        return (away @ kernel.frequencies).cos().mean(-1)
    return PROFILES[kernel.profile.name](away.square().sum(-1))


class Dense:
    """One output of a model at one draw of its numbers, in the user's units.

    f = sum_t mean_t b_t + sum_t (b_t - c_t) g_t, where b is a physics or 1, and g has the kernel of
    a term and an unknown constant. rho is its mean and g; delta has -sum c_t g_t besides.
    """

    def __init__(self, model, X, Y, physics, j, s, Yvar, ranges):
        m, unit, seen = Y.shape[-1], model.unit[j].item(), ~Y[:, j].isnan()
        self.seen, self.X, self.y = seen, X[seen], Y[seen, j]
        values = {name: v.detach() for name, v in model.values.items()}

        def number(name, default=None):
            return default if name not in values else values[name][s, j]

        self.names, self.bases, self.means, self.centers, self.kernels = [], [], [], [], []
        instead = 0.0  # the mean of delta in the place of f_p
        for term in model.terms:
            size, basis = unit**2, lambda X: torch.ones_like(X[:, 0])
            if term.physics is not None:
                own = physics[term.physics]
                size, basis = 1.0, lambda X, own=own: own(X).reshape(len(X), m)[:, j]
            c = 0.0 if term.physics is None else float(term.has_center)
            if term.has_center is True and term.physics is not None:
                c = basis(X).mean() + 3 * basis(X).std() * number(f"{term.name}.center")
            self.names.append(term.name)
            self.bases.append(basis)
            self.centers.append(c)
            share = number(f"{term.name}.mean", 1.0)
            self.means.append(term.mean * share)
            instead += (1 - share) * term.mean * c
            kappa = number(f"{term.name}.constant", 0.0) * size
            start = f"{term.name}.kernel."
            scale = number(f"{start}outputscale", 0.0) * size * number(f"{term.name}.process", 1.0)
            length = number(f"{start}lengthscale", 1.0) * ranges

            def k(A, B, term=term, kappa=kappa, scale=scale, length=length):
                if term.kernel is None:
                    return kappa * torch.ones(len(A), len(B), dtype=torch.float64)
                return scale * covariance(term.kernel, length, A, B) + kappa

            self.kernels.append(k)
        if "delta" in self.names:
            self.means[self.names.index("delta")] += instead
        if Yvar is None:
            Yvar = (number("noise.variance") + LEAST) * unit**2 * torch.ones_like(Y)
        self.noise = Yvar[seen, j]

    def mean(self, X):
        return sum(mean * b(X) for mean, b in zip(self.means, self.bases, strict=True))

    def whole(self):
        """The weights of the terms' deviations in f."""
        pairs = zip(self.bases, self.centers, strict=True)
        return [lambda X, b=b, c=c: b(X) - c for b, c in pairs]

    def cross(self, left, A, right, B):
        parts = zip(left, self.kernels, right, strict=True)
        return sum(a(A)[:, None] * k(A, B) * b(B)[None, :] for a, k, b in parts)

    def condition(self, weights, mean, Z, rows=None):
        rows = torch.ones_like(self.y, dtype=torch.bool) if rows is None else rows
        X, f = self.X[rows], self.whole()
        K = self.cross(f, X, f, X) + self.noise[rows].diag()
        cross = self.cross(weights, Z, f, X)
        mean = mean + cross @ torch.linalg.solve(K, self.y[rows] - self.mean(X))
        prior = self.cross(weights, Z, weights, Z)
        return mean, prior - cross @ torch.linalg.solve(K, cross.mT)

    def posterior(self, Z):
        return self.condition(self.whole(), self.mean(Z), Z)

    def term(self, Z, name):
        at = self.names.index(name)
        weights = [lambda X, one=float(i == at): 0 * X[:, 0] + one for i in range(len(self.names))]
        if name == "delta":
            for i, c in enumerate(self.centers[:-1]):
                weights[i] = lambda X, c=c: 0 * X[:, 0] - c
        return self.condition(weights, self.means[at], Z)

    def left_out(self):
        """Means and variances of the targets, each given all others; NaN where one is missing."""
        found = torch.full((2, len(self.seen)), torch.nan, dtype=torch.float64)
        for at, i in enumerate(self.seen.nonzero().flatten()):
            rows = torch.arange(len(self.y)) != at
            x = self.X[[at]]
            mean, K = self.condition(self.whole(), self.mean(x), x, rows)
            found[:, i] = torch.cat([mean, K[0] + self.noise[at]])
        return found

    def log_likelihood(self):
        f = self.whole()
        K = self.cross(f, self.X, f, self.X) + self.noise.diag()
        law = torch.distributions.MultivariateNormal(self.mean(self.X), K)
        return law.log_prob(self.y)


class Formulas:
    """All outputs and draws of a model: moments of the mixture, with outputs in front of points."""

    def __init__(self, model, X, Y, *physics, Yvar=None, ranges=1.0):
        S, m = len(model.u), model.num_outputs
        self.parts = [
            [Dense(model, X, Y, physics, j, s, Yvar, ranges) for j in range(m)] for s in range(S)
        ]

    def each(self, ask):
        """What a function of each part returns, ``S x m x ...``."""
        return torch.stack([torch.stack([ask(part) for part in row]) for row in self.parts])

    def moments(self, Z, name=None):
        """The mean ``q x m`` and the covariance ``m q x m q`` of f, or of a term."""

        def ask(part):
            mean, K = part.posterior(Z) if name is None else part.term(Z, name)
            return torch.cat([mean.unsqueeze(-1), K], -1)

        found = self.each(ask)
        mean, K = found[..., 0], found[..., 1:].mean(0)
        away = (mean - mean.mean(0)).flatten(1)
        return mean.mean(0).mT, torch.block_diag(*K) + away.mT @ away / len(away)


@pytest.fixture
def formulas():
    return Formulas


def _size(model, name):
    """What a number is multiplied by, to be in the user's units, ``m x 1``."""
    start, _, last = name.partition(".")
    plain = [term.name for term in model.terms if term.physics is None]
    last = last.rpartition(".")[2]
    is_squared = start in plain and last in ("outputscale", "constant")
    is_squared = is_squared or (start == "noise" and last != "relative")
    return model.unit.square() if is_squared else torch.ones_like(model.unit)


def _center(model, name):
    """The center's value where its coordinate is 0, and its scale, ``m x 1``."""
    (term,) = (term for term in model.terms if name == f"{term.name}.center")
    f = model.physics[term.physics](model.data.X).mT * torch.ones_like(model.unit)
    return f.mean(-1, keepdim=True), 3 * f.std(-1, keepdim=True)


def numbers_of(model):
    """The unknown numbers of a model by name, in the user's units."""
    found = {}
    for row in [*model.table.own, *model.table.shared]:
        value = model.table.values(model.u.detach())[row.name]
        if row.name.endswith(".center"):
            middle, scale = _center(model, row.name)
            value = middle + scale * value
        elif row.name != "choice" and not row.is_shared:
            value = (value + LEAST * row.name.startswith("noise")) * _size(model, row.name)
        found[row.name] = value
    return found


@pytest.fixture
def numbers():
    return numbers_of


@pytest.fixture
def give():
    """`give(model, numbers)`: hold numbers of the user's units; others keep their prior medians."""

    def give(model, numbers):
        S = max(len(value) for value in numbers.values())
        u, values = model.u.detach().new_zeros(S, *model.u.shape[1:]), {}
        for name in {row.name for row in model.table.own} & numbers.keys():
            value = numbers[name]
            if name.endswith(".center"):
                middle, scale = _center(model, name)
                value = (value - middle) / scale
            elif name != "choice":
                value = value / _size(model, name) - LEAST * name.startswith("noise")
            values[name] = value
        u = model.table.with_values(u, values)
        for i, row in enumerate(reversed(model.table.shared)):
            u[:, 0, -1 - i] = numbers[row.name][:, 0]
        model.set_draws(u)
        return model.eval()

    return give


@pytest.fixture
def drawn():
    """`drawn(model, number=3)`: hold random coordinates, of each nested model in turn."""

    def drawn(model, number=3, seed=0, spread=0.4, choice=None):
        table, generator = model.table, torch.Generator().manual_seed(seed)
        shape = (number, table.problems, table.size)
        u = spread * torch.randn(shape, generator=generator, dtype=torch.float64)
        if table.choices:
            which = [s % len(table.choices) if choice is None else choice for s in range(number)]
            u = torch.cat([table.with_choice(u[[s]], k) for s, k in enumerate(which)])
        model.set_draws(u)
        return model.eval()

    return drawn


@pytest.fixture
def alike(close):
    """Asserts that the means and the variances of two predictions or posteriors are equal."""

    def alike(p, q, tolerance=1e-8, outputs=slice(None)):
        close(p.mean, q.mean[..., outputs], tolerance)
        close(p.variance, q.variance[..., outputs], tolerance)

    return alike


@pytest.fixture
def same(close, alike):
    """Asserts that two models predict the same at `Z`: joint, one by one, and of each term."""

    def same(a, b, Z, tolerance=1e-8, noise=True):
        alike(a.predict(Z), b.predict(Z), tolerance)
        alike(a.predict(Z, noise), b.predict(Z, noise), tolerance)
        asks = [lambda m, name=t.name: m.term(name, Z) for t in a.terms if t.varies]
        for ask in (lambda m: m.posterior(Z), *asks):
            alike(ask(a), ask(b), tolerance)
            close(ask(a).covariance_matrix, ask(b).covariance_matrix, tolerance)

    return same
