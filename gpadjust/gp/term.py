"""A model is a sum of terms, each a basis times a Gaussian process."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Self

import torch
from gpytorch.kernels import Kernel
from gpytorch.means import Mean
from torch import Size, Tensor
from torch.nn import Module, ModuleList, Parameter

from gpadjust.gp.gaussian import scaled
from gpadjust.gp.kernels import (
    AnyKernel,
    Batched,
    CompositeKernel,
    Stationary,
    ToPoints,
    stationary_parts,
)


class Unit(Enum):
    """The unit of a term's Gaussian process, beside the model's targets."""

    NONE = "none"  # a number, as a scaling of the physics is
    DIFFERENCE = "difference"  # of targets: it is scaled
    TARGET = "target"  # it is shifted, too: the bias of a model


class Term(Batched):
    r"""A term :math:`b(x) g(x)` with :math:`g \sim GP(\bar g, k)`.

    The basis b is a column of the physics, or 1. The prior mean :math:`\bar g` is a constant:
    given, or unknown with the prior :math:`N(\bar g, \kappa)`, which adds :math:`\kappa` to the
    kernel; vague, as :func:`gpadjust.fit` sets it, that is universal kriging (Rasmussen and
    Williams 2006, sec. 2.7). All is in the units of the model's targets, after their transform.

    Args:
        name: What :meth:`~gpadjust.CKA.term` calls it: ``"rho"``, ``"delta"``.
        kernel: The kernel k on the leading input columns, or None for a g that is constant.
        num_inputs: How many columns these are.
        basis: A module that maps all columns, ``... x n x (d + k)``, to b, ``... x n``, as
            :class:`~gpadjust.gp.AppendedPhysics` does. None for 1.
        mean: The constant :math:`\bar g`, ``batch_shape x (m) x 1``.
        mean_variance: Its prior variance :math:`\kappa` to begin with; None if it is known.
        unit: The unit in which :meth:`~gpadjust.CKA.term` says g.
        scaled_by: The name of another term that is the basis: that of the scaling of a physics, if
            this term is an error of the physics, whose kernel then has no parameters.
    """

    basis: Any  # a module or None; it has `map_batches`, which mypy cannot know of a Module
    given_mean: Tensor  # which a sample that does without a physics has not

    def __init__(
        self,
        name: str,
        kernel: Kernel | None,
        num_inputs: int,
        basis: Module | None,
        mean: Tensor,
        mean_variance: Tensor | None = None,
        unit: Unit = Unit.DIFFERENCE,
        scaled_by: str | None = None,
    ) -> None:
        super().__init__()
        self.name = name
        self.scaled_by = scaled_by
        self.kernel = kernel
        self.num_inputs = num_inputs
        self.basis = basis
        self.unit = unit
        self.learns_mean = mean_variance is not None
        self.register_buffer("given_mean", mean.clone())
        self.mean = Parameter(mean.clone(), requires_grad=False)
        variance = torch.zeros_like(mean) if mean_variance is None else mean_variance.clone()
        self.mean_variance = Parameter(variance, requires_grad=False)

    @property
    def is_known(self) -> bool:
        """True if g is a known constant."""
        return self.kernel is None and not self.learns_mean

    @property
    def form(self) -> Stationary | AnyKernel | None:
        """The kernel at the values that its parameters have."""
        found = None if self.kernel is None else stationary_parts(self.kernel, self.num_inputs)
        if found is None:
            return None if self.kernel is None else AnyKernel(self.kernel)
        base, outer, profile = found
        scale = base.lengthscale.new_ones(()) if outer is None else outer.outputscale
        return Stationary(base.lengthscale, scale, profile)

    def weights(self, x: Tensor) -> Tensor | None:
        """The basis at ``x`` (``... x n x (d + k)``) as ``... x n``, or None for 1."""
        values: Tensor | None = None if self.basis is None else self.basis(x)
        return values

    def covariance(
        self,
        x1: Tensor,
        x2: Tensor | None = None,
        diag: bool = False,
        known_mean: bool = False,
        kernel: Tensor | None = None,
    ) -> Tensor:
        """The prior covariance of g, ``... x n x n'``, or its diagonal ``... x n``.

        ``x1`` is ``... x n x (d + k)``, as ``x2``, which is None for ``x1``. With ``known_mean``,
        kappa is zero; ``kernel`` is what the kernel is there, if it was computed already.
        """
        d, form = self.num_inputs, self.form if kernel is None else None
        if kernel is not None:
            total = kernel
        elif form is None:
            across = [] if diag else [(x1 if x2 is None else x2).shape[-2]]
            total = x1.new_zeros(()).expand(*x1.shape[:-1], *across)
        elif diag:
            total = form.diagonal(x1[..., :d])
        else:
            total = form.covariance(x1[..., :d], None if x2 is None else x2[..., :d])
        if self.learns_mean and not known_mean:
            total = total + (self.mean_variance if diag else self.mean_variance.unsqueeze(-1))
        return total


@dataclass(eq=False)
class WeightedSum:
    r"""A weighted sum of terms at inputs, :math:`\sum_t w_t(x) g_t(x)`: the one place that sums.

    With the bases for weights it is the model's function; with one weight of 1, a term of it.
    """

    x: Tensor  # ... x n x (d + k)
    parts: Sequence[tuple[Term, Tensor | None]]  # the terms and their weights, ... x n, None for 1
    shift: Tensor | float = 0.0  # what the prior mean has beside that, ... x 1
    # Of a term that another one scales, the product counts, where both are in the sum. Its mean is
    # zero, so that it is correlated with neither, and its covariance is a product, too.
    _prepared: dict[tuple[str, ...], ToPoints] = field(default_factory=dict, init=False)

    def combine(self, values: Mapping[str, Tensor]) -> Tensor:
        """Sum values of the terms by their names, ``k x ... x n``, times weights, and the shift."""
        total = torch.zeros_like(self.x[..., 0]) + self.shift
        for term, weight in self.parts:
            value = values[term.name]
            weight = values.get(term.scaled_by or "", weight)
            total = total + (value if weight is None else weight * value)
        return total

    def mean(self) -> Tensor:
        """The prior mean, ``... x n``."""
        return self.combine({term.name: term.mean for term, _ in self.parts})

    def variance(self, known_means: bool = False, data: WeightedSum | None = None) -> Tensor:
        """The prior variances, ``... x n``; ``known_means`` and ``data`` as in :meth:`cross`."""
        total, terms = torch.zeros_like(self.x[..., 0]), self._unknown(known_means)
        forms = {} if data is None else data._prepare(terms).forms
        found: dict[str, Tensor] = {}
        for term, weight in terms:
            known = forms[term.name].variance() if term.name in forms else None
            part = term.covariance(self.x, None, True, known_means, known)
            found[term.name] = part
            if term.scaled_by and (mean := self._mean_of_scaling(term)) is not None:
                part = part * (mean.square() + found.get(term.scaled_by or "", 0.0))
            total = total + (part if weight is None else part * weight.square())
        return total

    def covariance(self, known_means: bool = False) -> Tensor:
        """The prior covariance, ``... x n x n``."""
        return self.cross(self, known_means)

    def cross(self, other: WeightedSum, known_means: bool = False, is_data: bool = False) -> Tensor:
        """The prior covariance with another sum of the same terms, ``... x n x n'``.

        Terms that the other has not are independent of it; with ``known_means``, all kappa are
        zero. Data remember, without gradient to them, what makes this fast when asked often.
        """
        theirs = {term.name: weight for term, weight in other.parts}
        terms = [part for part in self._unknown(known_means) if part[0].name in theirs]
        kernels = other._prepare(terms)(self.x) if is_data else {}
        points = None if other is self else other.x
        total: Tensor | None = None
        found: dict[str, Tensor] = {}
        for term, left in terms:
            part = term.covariance(self.x, points, False, known_means, kernels.get(term.name))
            if any(other.scaled_by == term.name for other, _ in terms):
                found[term.name] = part.clone()  # it is scaled in place
            if term.scaled_by:
                means = [self._mean_of_scaling(term), other._mean_of_scaling(term)]
                known = [mean.unsqueeze(-1) for mean in means if mean is not None]
                both = found.get(term.scaled_by, 0.0) if len(known) > 1 else 0.0
                part = part * (math.prod(known) + both)
            for weight, dim in ((theirs[term.name], -2), (left, -1)):
                part = part if weight is None else scaled(part, weight.unsqueeze(dim))
            total = part if total is None else total + part
        return self.x.new_zeros(*self.x.shape[:-1], other.x.shape[-2]) if total is None else total

    def features(self, maps: Mapping[str, Module]) -> Tensor:
        """Features of the terms, ``... x n x D_t`` by their names, times weights, side by side."""
        weights = {term.name: weight for term, weight in self.parts}
        phi = []
        for name, each in maps.items():
            features, weight = each(self.x), weights.get(name, self.x.new_zeros(1))
            for term, _ in self.parts:
                if term.name == name and term.scaled_by:
                    weight = self._mean_of_scaling(term)
            phi.append(features if weight is None else features * weight.unsqueeze(-1))
        return side_by_side(phi)

    def __getstate__(self) -> dict[str, Any]:
        """All but what is remembered, which can be made again."""
        return {**vars(self), "_prepared": {}}

    def _mean_of_scaling(self, term: Term) -> Tensor | None:
        """The prior mean of what scales a term, ``... x 1``, if both are in the sum."""
        means = [other.mean for other, _ in self.parts if other.name == term.scaled_by]
        return means[0] if means else None

    def _unknown(self, known_means: bool) -> list[tuple[Term, Tensor | None]]:
        return [
            (term, weight)
            for term, weight in self.parts
            if term.kernel is not None or (term.learns_mean and not known_means)
        ]

    def _prepare(self, parts: Sequence[tuple[Term, Tensor | None]]) -> ToPoints:
        names = tuple(term.name for term, _ in parts)
        if names not in self._prepared:
            forms = {t.name: t.form for t, _ in parts}
            found = {name: form for name, form in forms.items() if isinstance(form, Stationary)}
            num_inputs = max((t.num_inputs for t, _ in parts if t.name in found), default=0)
            self._prepared[names] = ToPoints(found, self.x[..., :num_inputs])
        return self._prepared[names]


def side_by_side(parts: Sequence[Tensor]) -> Tensor:
    """Join the last dimensions of features, ``... x n x D_t``, whose batches broadcast."""
    shape = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return torch.cat([part.expand(*shape, part.shape[-1]) for part in parts], dim=-1)


class SumOfTerms(CompositeKernel):
    r"""The covariance :math:`\sum_t b_t(x)\,(k_t(x, x') + \kappa_t)\,b_t(x')` of a sum of terms.

    Args:
        terms: The terms; their names differ.
        known_means: Take the prior means as known, all kappa as zero.
    """

    terms: Any  # a ModuleList, of which mypy would not know that it holds terms

    def __init__(self, terms: Sequence[Term], known_means: bool = False) -> None:
        super().__init__()
        names = [term.name for term in terms]
        if len({*names}) < len(names):
            raise ValueError(f"Expected terms of different names, got {names}.")
        own = [{id(p) for p in term.parameters()} for term in terms]
        if len(set().union(*own)) < sum(map(len, own)):
            raise ValueError(
                f"Expected kernels of their own for the terms {names}, but some share parameters; "
                "pass each a kernel of its own (copy.deepcopy makes one)."
            )
        self.terms = ModuleList(terms)
        self.known_means = known_means

    @property
    def batch_shape(self) -> Size:
        """The batch shape of the terms."""
        return torch.broadcast_shapes(*(term.mean.shape[:-1] for term in self.terms))

    def at(self, x: Tensor, among: Collection[str] | None = None) -> WeightedSum:
        """The sum of the terms (or those ``among``) times their bases at ``... x n x (d + k)``."""
        terms = [term for term in self.terms if among is None or term.name in among]
        shift: Any = 0.0
        for term in terms:
            shift = shift + getattr(term.basis, "moved_mean", 0.0)
        parts = [(term, term.weights(x)) for term in terms]
        return WeightedSum(x, parts, shift)

    def covariance(self, x: Tensor, known_means: bool = False) -> Tensor:
        """Return ``... x n x n``; see :class:`WeightedSum`."""
        return self.at(x).covariance(known_means)

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Return ``... x n x n'``, or its diagonal ``... x n`` without building the matrix."""
        left = self.at(x1)
        if diag:
            return left.variance(self.known_means)
        same = x2 is x1 or torch.equal(x1, x2)
        return left.cross(left if same else self.at(x2), self.known_means)

    def basis_of_means(self, x: Tensor) -> Tensor | None:
        """The bases of the terms whose means are unknown, ``... x n x q``, or None."""
        bases = [term.weights(x) for term in self.terms if term.learns_mean]
        columns = [torch.ones_like(x[..., 0]) if basis is None else basis for basis in bases]
        return torch.stack(torch.broadcast_tensors(*columns), dim=-1) if columns else None

    def local_load_samples(self, samples_dict: Any, memo: Any, prefix: str) -> None:
        """GPyTorch's hook for Pyro's samples; the batch shape follows the terms."""
        super(Kernel, self).local_load_samples(samples_dict, memo, prefix)

    def map_batches(self, change: Callable[[Any], Any]) -> Self:
        """A copy whose terms are changed along their batch dimensions."""
        return type(self)([term.map_batches(change) for term in self.terms], self.known_means)


class TermsMean(Mean):
    r"""The prior mean :math:`\sum_t b_t(x) \bar g_t` of a sum of terms, by its covariance."""

    def __init__(self, covariance: SumOfTerms) -> None:
        super().__init__()
        # In a tuple, no submodule: the terms are the covariance's, and stand once in a state_dict.
        self._sum = (covariance,)

    def forward(self, x: Tensor) -> Tensor:
        """Return the mean at ``x`` (``... x n x (d + k)``) as ``... x n``."""
        return self._sum[0].at(x).mean()
