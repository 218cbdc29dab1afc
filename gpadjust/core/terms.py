"""A model is a sum of terms, each a basis times a Gaussian process: the one place that sums."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.core.gpytorch_kernels import OfGPyTorch
from gpadjust.core.kernels import DELTA, RBF, RHO, Features, Kernel, PullBack, Stationary
from gpadjust.core.unknowns import LogNormal, Row, Values


class Term(NamedTuple):
    r"""A term :math:`b(x) g(x)` of a model, :math:`g \sim GP(\text{mean}, k + \kappa)`.

    The basis b is a physics, or 1. Where it is 1, numbers of g are in the targets' unit.

    Args:
        name: The name.
        kernel: k, if any.
        mean: The prior mean of g; in the user's units, where b is 1.
        constant: The prior of :math:`\kappa`, the variance of an unknown constant in g, if any.
        physics: The number of the physics that is the basis; None for 1.
        has_center: Whether g's deviation from its mean is multiplied by b - c instead of b, with an
            unknown c or the number c; the prior mean of the sum does not depend on it.
    """

    name: str
    kernel: Kernel | None = None
    mean: float = 0.0
    constant: LogNormal | None = None
    physics: int | None = None
    has_center: bool | float = False

    @property
    def varies(self) -> bool:
        """Whether g differs from its mean."""
        return self.kernel is not None or self.constant is not None


def as_kernel(kernel: Any, outputscale: LogNormal = DELTA) -> Kernel:
    """Return a kernel of this library, one of GPyTorch in a wrapper, or the default RBF."""
    if kernel is None:
        return Stationary(RBF, outputscale)
    if isinstance(kernel, Kernel):
        return kernel.of_term(outputscale)
    return OfGPyTorch(kernel, outputscale)


def with_kernel(term: Any) -> Term:
    """Return a term with a kernel of this library, also where it has one of GPyTorch."""
    if not isinstance(term, Term):
        raise TypeError(f"Expected terms as a list of Term(name, kernel, ...); found {term!r}.")
    if term.kernel is None:
        return term
    kernel = as_kernel(term.kernel, DELTA if term.physics is None else RHO)
    if not kernel.has_constant:
        term = term._replace(constant=None)
    return term._replace(kernel=kernel)


class Places(NamedTuple):
    """Points at which a sum is evaluated."""

    kernel_inputs: Tensor  # X after the input transform, ... x 1 x 1 x n x d
    f: Sequence[Tensor]  # the outputs of each physics, ... x S x m x n (1 for S)
    X: Tensor  # the inputs as the user gave them, ... x 1 x 1 x n x d


@dataclass
class WeightedSum:
    r"""A sum :math:`\bar f(x) + \sum_t w_t(x) \tilde g_t(x)` at some places, and its covariances.

    :math:`\tilde g_t` are the deviations of the terms from their means. The function itself is such
    a sum, and so are rho and delta.
    """

    terms: Sequence[Term]
    values: Values
    x: Tensor
    mean: Tensor  # ... x S x m x n
    weights: dict[str, Tensor]  # tensors w_t, shaped as the mean, of the terms in the sum
    ready: dict[str, Callable[[Tensor], Tensor]] = field(default_factory=dict)  # of kernels

    def of_rows(self, rows: slice | Tensor) -> WeightedSum:
        """Return the sum at some of its places."""
        weights = {name: w[..., rows] for name, w in self.weights.items()}
        mean = self.mean[..., rows]
        return WeightedSum(self.terms, self.values, self.x[..., rows, :], mean, weights)

    def own(self, term: Term) -> Values:
        """Return the parameters of a term's kernel."""
        start = f"{term.name}.kernel."
        return {n.removeprefix(start): v for n, v in self.values.items() if n.startswith(start)}

    def toward(self, term: Term, x: Tensor) -> Tensor:
        """Return the covariances of a term's kernel at inputs with the places of the sum."""
        if term.name not in self.ready:
            assert term.kernel is not None, "checked by the caller"
            self.ready[term.name] = term.kernel.toward(self.own(term), self.x)
        return self.ready[term.name](x)

    def variance(self) -> Tensor:
        r"""Return the prior variances, :math:`\sum_t w_t^2 (k_t(x, x) + \kappa_t)`."""
        total = torch.zeros_like(self.x[..., 0])
        for term, weight in self._parts():
            k = self._constant(term)
            if term.kernel is not None:
                variance = term.kernel.variance(self.own(term), self.x)
                k = k + self._process(term, variance.unsqueeze(-1)).squeeze(-1)
            total = total + k * weight.square()  # w^2 (k + kappa)
        return total

    def cross(self, other: WeightedSum) -> Tensor:
        r"""Return the prior covariances with another sum, ``... x S x m x n x n'``.

        .. math:: \sum_t w_t(x) \, (k_t(x, x') + \kappa_t) \, w'_t(x')
        """
        total = self.x.new_zeros(self.x.shape[-2], other.x.shape[-2])
        for term, weight in self._parts():
            if term.name not in other.weights:
                continue
            k = self._constant(term).unsqueeze(-1)
            if term.kernel is not None:
                points = (self.x,) if other is self else (self.x, other.x)
                k = k + self._process(term, term.kernel.covariance(self.own(term), *points))
            # w (k + kappa) w'
            total = total + k * weight.unsqueeze(-1) * other.weights[term.name].unsqueeze(-2)
        return total

    def cross_times(self, other: WeightedSum, vectors: Tensor) -> Tensor:
        r"""Return the covariances with another sum times V, ``... x S x m x n' x k``, term by term.

        .. math:: \sum_t w_t(x) \, (k_t(x, x') + \kappa_t) \, (w'_t(x') \circ V)
        """
        total = torch.zeros_like(self.mean).unsqueeze(-1)
        for term, weight in self._parts():
            if term.name in other.weights:
                V = other.weights[term.name].unsqueeze(-1) * vectors
                part = self._constant(term).unsqueeze(-1) * V.sum(-2, keepdim=True)
                if term.kernel is not None:
                    part = part + self._process(term, other.toward(term, self.x) @ V)
                total = total + weight.unsqueeze(-1) * part
        return total

    def with_pull_back(self) -> tuple[Tensor, PullBack]:
        """Return the covariance, and a function of D = df/dK that gives df by all parameters.

        Derivatives by the weights of physics have the names ``"<term>.weight"``.
        """
        total = self.x.new_zeros(self.x.shape[-2], self.x.shape[-2])
        steps = []
        for term, w in self._parts():
            column, row = w.unsqueeze(-1), w.unsqueeze(-2)
            K = back = None
            if term.kernel is not None:
                K, back = term.kernel.with_pull_back(self.own(term), self.x)
                K = self._process(term, K)
                total = total + (K * column).mul_(row)  # w_i K_ij w_j
            if term.constant is not None:  # kappa w_i w_j
                total = torch.addcmul(total, self._constant(term).unsqueeze(-1) * column, row)
            steps.append((term, column, row, K, back))

        def pull_back(D: Tensor) -> Values:
            by: Values = {}
            for term, column, row, K, back in steps:
                by_k = (D * column).mul_(row)
                if back is not None:
                    by_kernel = back(self._process(term, by_k))
                    by |= {f"{term.name}.kernel.{n}": slope for n, slope in by_kernel.items()}
                if term.constant is not None:
                    by[f"{term.name}.constant"] = by_k.sum((-1, -2)).unsqueeze(-1)
                if term.physics is not None:
                    # Of w_i (K_ij + kappa) w_j it is 2 sum_j D_ij (K_ij + kappa) w_j.
                    by_w = self._constant(term) * (D @ column).squeeze(-1)
                    if K is not None:
                        by_w = by_w + ((D * K) @ column).squeeze(-1)
                    by[f"{term.name}.weight"] = 2 * by_w
            return by

        return total, pull_back

    def features(self, of_kernels: Mapping[str, Features]) -> Tensor:
        r"""Return features ``... x S x m x n x p`` of the sum, for weights N(0, I).

        .. math:: \left( w_t \varphi_t(x), \; w_t \sqrt{\kappa_t} \right)_t

        Args:
            of_kernels: :math:`\varphi_t` by the names of the terms.
        """
        parts = [self.mean.unsqueeze(-1)[..., :0]]  # p = 0 where no term varies
        for term in self.terms:
            w = self.weights.get(term.name, torch.zeros_like(self.mean)).unsqueeze(-1)
            if term.kernel is not None:
                parts.append(self._process(term, of_kernels[term.name](self.x)) * w)
            if term.constant is not None:
                parts.append(self._constant(term).sqrt().unsqueeze(-1) * w)
        lead = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
        return torch.cat([part.expand(*lead, part.shape[-1]) for part in parts], -1)

    def _parts(self) -> list[tuple[Term, Tensor]]:
        """Return the terms that vary and have a weight, without processes that no draw contains."""
        parts = []
        for term in self.terms:
            process = self.values.get(f"{term.name}.process")
            if process is not None and not process.any():
                term = term._replace(kernel=None)
            if term.name in self.weights and (term.kernel, term.constant) != (None, None):
                parts.append((term, self.weights[term.name]))
        return parts

    def _process(self, term: Term, K: Tensor) -> Tensor:
        """Return covariances of a term's process, 0 for draws of nested models without it."""
        process = self.values.get(f"{term.name}.process")
        if process is None:
            return K
        return K * process.unsqueeze(-1)

    def _constant(self, term: Term) -> Tensor:
        """Return kappa, ``S x m x 1``."""
        if term.constant is None:
            return torch.zeros_like(self.x[..., :1, 0])
        return self.values[f"{term.name}.constant"]


class TermSum:
    """The terms of a model: their unknown numbers, and the weighted sums that they make.

    The outputs f of each physics at the training inputs are ``m x n``, in a unit ``m x 1``.
    """

    def __init__(self, terms: Sequence[Term], f: Sequence[Tensor], unit: Tensor) -> None:
        names = [term.name for term in terms]
        if len({*names}) < len(names) or not names or any("." in name for name in names):
            raise ValueError(f"Expected terms with different names without dots; found {names}.")
        for name, i in ((t.name, t.physics) for t in terms if t.physics is not None):
            if not 0 <= i < len(f):
                raise ValueError(f"Term {name!r} has physics number {i} of {len(f)} in physics=.")
        self.terms = tuple(
            term._replace(has_center=term.physics is not None and term.has_center) for term in terms
        )
        plain = [term.name for term in terms if term.physics is None]
        self.plain = "delta" if "delta" in plain else next(iter(plain), None)
        self.unit = unit
        self.f = [v.reshape(-1, v.shape[-1]) for v in f]
        # The prior mean and standard deviation of a center, m x 1.
        self.middle = [v.mean(-1, keepdim=True) for v in self.f]
        self.spread = [3 * v.std(-1, keepdim=True) for v in self.f]

    def rows(self, x: Tensor, num_outputs: int) -> list[Row]:
        """Return the unknown numbers of all terms, for training inputs ``n x d``."""
        rows: list[Row] = []
        for term in self.terms:
            if term.kernel is not None:
                of_kernel = term.kernel.rows(x, num_outputs)
                rows += [row._replace(name=f"{term.name}.kernel.{row.name}") for row in of_kernel]
            if term.constant is not None:
                median = x.new_full((num_outputs, 1), term.constant.median)
                rows.append(Row.positive(f"{term.name}.constant", median, term.constant.factor))
            if term.has_center is True:
                # c has a scale of its own in each output, so that its coordinate has none.
                rows.append(Row(f"{term.name}.center", x.new_zeros(num_outputs, 1)))
        return rows

    def center(self, term: Term, values: Values) -> Tensor:
        """Return c, ``S x m x 1``: normal around the mean of f_p, by three standard deviations."""
        if term.has_center is not True:
            return term.has_center / self.unit
        i = term.physics or 0
        # c = mean of f_p + 3 sd u
        return self.middle[i] + self.spread[i] * values[f"{term.name}.center"]

    def mean_of(self, term: Term, values: Values) -> Tensor | float:
        """Return the prior mean of a term's process, which is zero in some nested models.

        There delta has c in the place of f_p: a model without physics keeps its constant.
        """
        if term.physics is not None:
            return term.mean * values.get(f"{term.name}.mean", 1.0)
        mean = term.mean / self.unit
        if term.name == self.plain:
            for other in self.terms:
                if (factor := values.get(f"{other.name}.mean")) is not None:
                    mean = mean + other.mean * (1 - factor) * self.center(other, values)
        return mean

    def mean(self, values: Values, places: Places) -> Tensor:
        """Return the prior mean of the sum, ``... x S x m x n``."""
        total = torch.zeros_like(places.kernel_inputs[..., 0])
        for term in self.terms:
            mean = self.mean_of(term, values)
            if term.physics is not None:
                mean = mean * places.f[term.physics]
            total = total + mean  # b times the mean of g
        return total

    def evaluate(self, values: Values, places: Places) -> WeightedSum:
        r"""Return the function itself, :math:`\sum_t b_t g_t`."""
        weights, x = {}, places.kernel_inputs
        for term in self.terms:
            b = torch.ones_like(x[..., 0])
            if term.physics is not None:
                b = places.f[term.physics] - self.center(term, values)  # f_p - c
            weights[term.name] = b
        return WeightedSum(self.terms, values, x, self.mean(values, places), weights)

    def term(self, name: str, values: Values, places: Places) -> WeightedSum:
        r"""Return the process of a term in the user's meaning, :math:`f = \sum_t b_t g_t`.

        delta is the term of this name, or the first without a basis.
        """
        term = next(t for t in self.terms if t.name == name)
        one = torch.ones_like(places.kernel_inputs[..., 0])
        weights = {name: one}
        # rho (f_p - c) + delta' = rho f_p + (delta' - c (rho - 1)), but for the means
        if name == self.plain:
            centered = [t for t in self.terms if t.has_center]
            weights |= {t.name: -self.center(t, values) * one for t in centered}
        mean = self.mean_of(term, values) * one
        return WeightedSum(self.terms, values, places.kernel_inputs, mean, weights)
