"""A model is a sum of terms, each a basis times a Gaussian process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import torch
from gpytorch.kernels import Kernel
from gpytorch.means import Mean
from linear_operator import to_dense
from torch import Size, Tensor
from torch.nn import Module, ModuleList, Parameter

from gpadjust.gp.stationary import exponents, rows_of, stationary_form


class Term(Module):
    r"""A term :math:`b(x) g(x)` with :math:`g \sim GP(\bar g, k)`.

    The basis b is a column of the physics, or 1. The prior mean :math:`\bar g` is a constant:
    given, or unknown with the prior :math:`N(\bar g, \kappa)`, which adds :math:`\kappa` to the
    kernel. With a vague :math:`\kappa`, as :func:`gpadjust.fit` sets it, that is universal
    kriging (Rasmussen and Williams 2006, sec. 2.7).

    All is in the units of the model's targets, after their transform.

    Args:
        name: What :meth:`~gpadjust.CKA.term` calls it: ``"rho"``, ``"delta"``.
        kernel: The kernel k on the leading input columns, or None for a g that is constant.
        num_inputs: How many columns these are.
        basis: A module that maps all columns, ``... x n x (d + k)``, to b, ``... x n``; such as
            :class:`~gpadjust.gp.AppendedPhysics`. None for 1.
        mean: The constant :math:`\bar g`, ``batch_shape x (m) x 1``.
        mean_variance: Its prior variance :math:`\kappa` to begin with, of the same shape; None if
            it is known.
    """

    basis: Any  # a module or None; it has `map_batches`, which mypy cannot know of a Module

    def __init__(
        self,
        name: str,
        kernel: Kernel | None,
        num_inputs: int,
        basis: Module | None,
        mean: Tensor,
        mean_variance: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.name = name
        self.kernel = kernel
        self.num_inputs = num_inputs
        self.basis = basis
        self.learns_mean = mean_variance is not None
        self.mean = Parameter(mean.clone(), requires_grad=False)
        variance = torch.zeros_like(mean) if mean_variance is None else mean_variance.clone()
        self.mean_variance = Parameter(variance, requires_grad=False)

    @property
    def is_known(self) -> bool:
        """Whether g is a known constant."""
        return self.kernel is None and not self.learns_mean

    @property
    def moved_mean(self) -> Tensor | float:
        """What the prior mean has beside that of g times the basis, ``... x 1``, or 0."""
        moved: Tensor | float = getattr(self.basis, "moved_mean", 0.0)
        return moved

    def weights(self, x: Tensor) -> Tensor | None:
        """The basis at ``x`` (``... x n x (d + k)``) as ``... x n``, or None for 1."""
        values: Tensor | None = None if self.basis is None else self.basis(x)
        return values

    def covariance(
        self, x1: Tensor, x2: Tensor, diag: bool = False, known_mean: bool = False
    ) -> Tensor:
        """The prior covariance of g, ``... x n x n'``, or its diagonal ``... x n``.

        Args:
            x1: ``... x n x (d + k)``.
            x2: ``... x n' x (d + k)``.
            diag: Whether only the diagonal is wanted, for ``x1 = x2``.
            known_mean: Take the mean as known.
        """
        constant = None
        if self.learns_mean and not known_mean:
            constant = self.mean_variance if diag else self.mean_variance.unsqueeze(-1)
        if self.kernel is None:
            shape = x1.shape[:-1] if diag else (*x1.shape[:-1], x2.shape[-2])
            zero = x1.new_zeros(()) if constant is None else constant
            return zero.expand(torch.broadcast_shapes(shape, zero.shape))
        d = self.num_inputs
        result = self._closed_form(x1[..., :d], x2[..., :d], diag)
        if result is None:
            result = to_dense(self.kernel(x1[..., :d], x2[..., :d], diag=diag))
        return result if constant is None else result + constant

    def log_covariance_with(self, train: Tensor, origin: Tensor) -> Tensor | None:
        r"""A matrix R that makes the logarithms of the kernel between any inputs and the data.

        With :math:`\tilde x = x - o` they are :math:`[\tilde x, \tilde x^2, 1] \, R`, one product
        for any inputs; without gradients to hyper-parameters.

        Args:
            train: ``... x n x (d + k)``.
            origin: :math:`o`, ``... x 1 x d``.

        Returns:
            ``... x (2 d + 1) x n``; None if the kernel is no scaled RBF kernel.
        """
        found = self._scaled_rbf()
        if found is None:
            return None
        lengthscale, scale = (t.detach() for t in found)
        z, half = rows_of(train[..., : self.num_inputs] - origin, lengthscale)
        square = (-0.5 / lengthscale.square()).expand_as(z)
        last = scale.log()[..., None, None] - half
        return torch.cat([z / lengthscale, square, last], dim=-1).mT.contiguous()

    def variance(self) -> Tensor | None:
        """The prior variance of g, ``... x 1``, if it is the same everywhere; without gradient."""
        constant = self.mean_variance.detach() if self.learns_mean else None
        if self.kernel is None:
            return constant
        if stationary_form(self.kernel, self.num_inputs) is None:
            return None
        scale = self._parameters_of_form()[1].detach().unsqueeze(-1)
        return scale if constant is None else scale + constant

    def _closed_form(self, x1: Tensor, x2: Tensor, diag: bool) -> Tensor | None:
        """A scaled RBF kernel, several times faster than through GPyTorch's modules."""
        found = self._scaled_rbf()
        if found is None:
            return None
        lengthscale, scale = found
        if diag:
            batch = torch.broadcast_shapes(x1.shape[:-2], scale.shape)
            return scale.unsqueeze(-1).expand(*batch, x1.shape[-2])
        origin = x1.detach().mean(-2, keepdim=True)
        exponent = exponents(rows_of(x1 - origin, lengthscale), rows_of(x2 - origin, lengthscale))
        if x1 is x2:
            # The closest pairs come out as differences of large numbers, these known ones do not.
            zero = torch.eye(x1.shape[-2], dtype=torch.bool, device=x1.device)
            exponent = exponent.masked_fill(zero, 0.0)
        return scale[..., None, None] * exponent.clamp_max(0.0).exp()

    def _scaled_rbf(self) -> tuple[Tensor, Tensor] | None:
        """As :meth:`_parameters_of_form`, of a scaled RBF kernel; None for any other."""
        form = stationary_form(self.kernel, self.num_inputs)
        return None if form is None or form.profile is not None else self._parameters_of_form()

    def _parameters_of_form(self) -> tuple[Tensor, Tensor]:
        """Lengthscales ``... x 1 x d`` and outputscale ``...`` of a stationary kernel."""
        kernel: Any = self.kernel
        if hasattr(kernel, "outputscale"):
            return kernel.base_kernel.lengthscale, kernel.outputscale
        return kernel.lengthscale, kernel.lengthscale.new_ones(())

    def map_batches(self, change: Callable[[Any], Any]) -> Term:
        """A copy whose kernel and tensors are changed along their batch dimensions."""
        new = deepcopy(self)
        new.kernel = None if self.kernel is None else change(self.kernel)
        new.basis = None if self.basis is None else self.basis.map_batches(change)
        for name in ("mean", "mean_variance"):
            setattr(new, name, Parameter(change(getattr(self, name).detach()), requires_grad=False))
        return new


class SumOfTerms(Kernel):
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
    def is_stationary(self) -> bool:
        """False, as the covariance follows the bases."""
        return False

    @property
    def batch_shape(self) -> Size:
        """The batch shape of the terms."""
        return torch.broadcast_shapes(*(term.mean.shape[:-1] for term in self.terms))

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: Any) -> Tensor:
        """Return ``... x n x n'``, or its diagonal ``... x n`` without building the matrix."""
        return self.covariance(x1, x2, diag, self.known_means)

    def covariance(
        self, x1: Tensor, x2: Tensor | None = None, diag: bool = False, known_means: bool = False
    ) -> Tensor:
        """As :meth:`forward`; with ``known_means``, all kappa are zero."""
        if x2 is None or x2 is x1 or torch.equal(x1, x2):
            x2 = x1
        total: Tensor | None = None
        for term in self.terms:
            if term.kernel is None and (known_means or not term.learns_mean):
                continue
            part = term.covariance(x1, x2, diag, known_means)
            if term.basis is not None:
                b1 = term.basis(x1)
                b2 = b1 if x2 is x1 else term.basis(x2)
                # Dense scaling is faster here than a product of diagonal linear operators.
                part = part * b1 * b2 if diag else part * b1.unsqueeze(-1) * b2.unsqueeze(-2)
            total = part if total is None else total + part
        if total is None:  # all is known
            total = self.terms[0].covariance(x1, x2, diag, known_mean=True)
        return total

    def basis_of_means(self, x: Tensor) -> Tensor | None:
        """The bases of the terms whose means are unknown, ``... x n x q``, or None."""
        one = torch.ones_like(x[..., 0])
        bases = [term.weights(x) for term in self.terms if term.learns_mean]
        if not bases:
            return None
        columns = [one if basis is None else basis for basis in bases]
        return torch.stack(torch.broadcast_tensors(*columns), dim=-1)

    def local_load_samples(self, samples_dict: Any, memo: Any, prefix: str) -> None:
        """GPyTorch's hook for Pyro's samples; the batch shape follows the terms."""
        super(Kernel, self).local_load_samples(samples_dict, memo, prefix)

    def __getitem__(self, index: Any) -> SumOfTerms:
        """The kernel of a part of the batch."""
        if not self.batch_shape:
            return self
        index = index if isinstance(index, tuple) else (index,)
        return self._map(lambda part: part[index])

    def expand_batch(self, *sizes: Any) -> SumOfTerms:
        """The kernel with its batch expanded to ``sizes``."""
        shape = Size(sizes[0]) if len(sizes) == 1 and not isinstance(sizes[0], int) else Size(sizes)
        lead = len(self.batch_shape)
        return self._map(
            lambda part: (
                part.expand_batch(shape)
                if isinstance(part, Kernel)
                else part.expand(*shape, *part.shape[lead:])
            )
        )

    def _map(self, change: Callable[[Any], Any]) -> SumOfTerms:
        """A copy whose kernels and tensors are changed along their batch dimensions."""
        return SumOfTerms([term.map_batches(change) for term in self.terms], self.known_means)


class TermsMean(Mean):
    r"""The prior mean :math:`\sum_t b_t(x) \bar g_t` of a sum of terms.

    Args:
        covariance: The covariance of the sum, which owns the terms.
    """

    def __init__(self, covariance: SumOfTerms) -> None:
        super().__init__()
        # Not as a submodule: the terms are the covariance's, and stand once in a state_dict.
        self.__dict__["covariance"] = covariance

    def forward(self, x: Tensor) -> Tensor:
        """Return the mean at ``x`` (``... x n x (d + k)``) as ``... x n``."""
        total = torch.zeros_like(x[..., 0])
        for term in self.covariance.terms:
            part = term.mean if term.basis is None else term.basis(x) * term.mean
            total = total + part + term.moved_mean
        return total
