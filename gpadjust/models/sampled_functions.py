"""Functions drawn from the posterior of a sum of terms, to be called anywhere."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from copy import deepcopy
from typing import Any

import torch
from botorch.sampling.pathwise.features import FeatureMap, gen_kernel_features
from botorch.sampling.pathwise.features.generators import GenKernelFeatures
from gpytorch.kernels import AdditiveKernel, ConstantKernel, Kernel, RFFKernel, ScaleKernel
from torch import Size, Tensor
from torch.nn import Module, ModuleList

from gpadjust.gp import OrthogonalKernel, SumOfTerms, Term
from gpadjust.models.cholesky_strategy import covariances, prepare
from gpadjust.models.hyperparameter_samples import take_samples
from gpadjust.physics.base import whole_number


class SampledFunctions(Module):
    r"""Deterministic functions from a posterior, by Matheron's rule (Wilson et al. 2020).

    Each is a function from the prior, on random Fourier features :math:`\varphi_t` of the terms,
    plus the exact update that makes it meet the data,

    .. math:: f(x) = \sum_t b_t(x) \left[ \bar g_t + \varphi_t(x)^T w_t
        + k_t(x, X) B_t v \right], \quad v = K^{-1} (y - f_{prior}(X) - \varepsilon).

    They can be called anywhere, so that particles that follow one of them stay consistent along a
    trajectory; gradients flow to the inputs as far as f_p allows, which is evaluated once a call.

    Args:
        model: The model; later changes of it have no effect here.
        features: The features of each term.
        weights: The weights w of each term, ``k x batch_shape x (m) x D_t``.
        updates: :math:`B_t v` of each term, ``k x batch_shape x (m) x n``, None for one that the
            data do not reach; none at all for functions that the weights say all about.
    """

    terms: Any  # modules, as those of the model
    features: Any
    shift: Tensor
    scale: Tensor

    def __init__(
        self,
        model: Any,
        features: Sequence[TermFeatures],
        weights: Sequence[Tensor],
        updates: Sequence[Tensor | None] = (),
    ) -> None:
        super().__init__()
        self.input_transform = deepcopy(getattr(model, "input_transform", None))
        self.has_outputs = model.num_outputs > 1
        self.batch_shape: Size = model.batch_shape
        # Together, as the features read the kernels of the terms.
        self.terms, self.features = deepcopy((ModuleList(model.terms), ModuleList(features)))
        for name, tensor in zip(("shift", "scale"), model._units(), strict=True):
            self.register_buffer(name, tensor)
        self.weights, self.updates = [*weights], [*updates]
        self.requires_grad_(False).eval()
        updated = [t for t, u in zip(self.terms, self.updates, strict=False) if u is not None]
        unknown = [term for term in updated if not term.is_known]
        self.data = prepare(unknown, model.strategy().train_inputs[0].detach()) if unknown else None

    @classmethod
    def by_matheron(cls, model: Any, num_functions: int, num_features: int) -> SampledFunctions:
        """Draw ``k`` functions of each batch of a model from its posterior."""
        strategy = model.strategy()
        (train,) = strategy.train_inputs
        with torch.no_grad():
            features = [TermFeatures(term, num_features) for term in model.terms]
            shape = (num_functions, *model._aug_batch_shape)
            weights = [
                torch.randn(*shape, each.num_features, dtype=torch.float64).to(train)
                for each in features
            ]
            reached = {term.name for term in strategy.kernel.terms}
            prior = cls(model, features, weights)._values(train, among=reached)
            update = strategy.pathwise_update(prior)
            return cls(model, features, weights, _by_terms(model, update))

    @classmethod
    def mean(cls, model: Any) -> SampledFunctions:
        """The posterior mean of each batch of a model, as a single function."""
        with torch.no_grad():
            alpha = model.strategy().mean_cache.unsqueeze(0)
            features = [TermFeatures(term, 0) for term in model.terms]
            weights = [alpha[..., :0]] * len(features)
            return cls(model, features, weights, _by_terms(model, alpha))

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x m``."""
        lead = torch.broadcast_shapes(X.shape[:-2], self.batch_shape)
        extra = len(lead) - len(self.batch_shape)
        inputs = self._inputs(X.expand(*lead, *X.shape[-2:]))
        return self._to_user(self._values(inputs, extra))

    def each(self, X: Tensor) -> Tensor:
        """Evaluate each function at points of its own.

        Args:
            X: Raw inputs, ``k x q x d``; of a model without a batch shape.

        Returns:
            ``k x q x m``: the i-th function at the i-th block of points.
        """
        return self._to_user(self._values(self._inputs(X)))

    def _inputs(self, X: Tensor) -> Tensor:
        X = X.unsqueeze(-3) if self.has_outputs else X
        inputs: Tensor = X if self.input_transform is None else self.input_transform(X)
        return inputs

    def _to_user(self, values: Tensor) -> Tensor:
        values = values * self.scale + self.shift
        return values.mT if self.has_outputs else values.unsqueeze(-1)

    def _values(self, inputs: Tensor, extra: int = 0, among: set[str] | None = None) -> Tensor:
        """The functions in model units, ``k x ... x (m) x q``.

        Args:
            inputs: Transformed inputs, ``... x (m) x q x d``.
            extra: How many dimensions of them lead those of the model.
            among: The names of the terms to sum. Default: all.
        """
        total = inputs.new_zeros(())
        cross = iter([] if self.data is None else covariances(self.data, inputs))
        for i, (term, features) in enumerate(zip(self.terms, self.features, strict=True)):
            if among is not None and term.name not in among:
                continue
            part = term.mean + _product(features(inputs), self.weights[i], extra)
            update = self.updates[i] if self.updates and not term.is_known else None
            if update is not None:
                part = part + _product(next(cross), update, extra)
            basis = term.weights(inputs)
            total = total + (part if basis is None else part * basis) + term.moved_mean
        return total


def _by_terms(model: Any, update: Tensor) -> list[Tensor | None]:
    """The update of a sum as one of each term, ``k x ... x n``; None for what data do not reach."""
    strategy = model.strategy()
    reached = {term.name for term in strategy.kernel.terms}
    parts: list[Tensor | None] = []
    for term in model.terms:
        basis = term.weights(strategy.train_inputs[0])
        part = update if basis is None else basis * update
        parts.append(part if term.name in reached else None)
    return parts


def _product(matrix: Tensor, vectors: Tensor, extra: int) -> Tensor:
    """Matrices ``extra x ... x q x n`` times vectors ``k x ... x n``: ``k x extra x ... x q``."""
    if not extra and matrix.dim() == vectors.dim():
        # One matrix for all k, which would be copied for each.
        return (matrix @ vectors.movedim(0, -1)).movedim(-1, 0)
    vectors = vectors.reshape(vectors.shape[0], *[1] * extra, *vectors.shape[1:])
    return (matrix @ vectors.unsqueeze(-1)).squeeze(-1)


class TermFeatures(Module):
    r"""Random features of a term's Gaussian process, of covariance :math:`\varphi(x)^T\varphi(x')`.

    Args:
        term: The term.
        num_features: Number of features of each stationary kernel; 0 for none of any term.
    """

    def __init__(self, term: Term, num_features: int) -> None:
        super().__init__()
        self.num_inputs = term.num_inputs
        kernel = term.kernel if num_features else None
        self.maps = ModuleList(_feature_maps(kernel, term.num_inputs, num_features))
        self.mean_variance = term.mean_variance if term.learns_mean and num_features else None
        with torch.no_grad():
            self.num_features = self(term.mean.new_zeros(1, term.num_inputs)).shape[-1]

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D`` at ``x``, ``... x n x (d + k)``."""
        parts = [each(x[..., : self.num_inputs]) for each in self.maps]
        if self.mean_variance is not None:
            root = self.mean_variance.sqrt().unsqueeze(-1)
            parts.append(root.expand(*root.shape[:-2], x.shape[-2], 1))
        return side_by_side(parts) if parts else x.new_zeros(*x.shape[:-1], 0)


def side_by_side(parts: Sequence[Tensor]) -> Tensor:
    """Join the last dimensions of features, ``... x n x D_t``, whose batches broadcast."""
    shape = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
    return torch.cat([part.expand(*shape, part.shape[-1]) for part in parts], dim=-1)


def weighted(features: Sequence[Tensor], weights: Sequence[Tensor | None]) -> Tensor:
    """Features of terms, ``... x n x D_t``, times weights ``... x n`` (None: 1), side by side."""
    parts = zip(features, weights, strict=True)
    return side_by_side([phi if w is None else phi * w.unsqueeze(-1) for phi, w in parts])


class KernelFeatures(Module):
    """The features that an ``RFFKernel`` is made of, or those of a ``ConstantKernel``."""

    def __init__(self, kernel: Kernel, scale: ScaleKernel | None) -> None:
        super().__init__()
        self.kernel = kernel
        self.scale = scale

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        if isinstance(self.kernel, ConstantKernel):
            root: Tensor = self.kernel.constant.sqrt().unsqueeze(-1)
            features = root.expand(*root.shape[:-2], x.shape[-2], 1)
        else:
            features = self.kernel._featurize(x, normalize=True)
        if self.scale is not None:
            features = features * self.scale.outputscale.sqrt()[..., None, None]
        return features


class OrthogonalFeatures(Module):
    """The features of an ``OrthogonalKernel``: those of its base kernel, less what they are not."""

    def __init__(self, kernel: OrthogonalKernel, maps: Sequence[Module]) -> None:
        super().__init__()
        self.kernel = kernel
        self.maps = ModuleList(maps)
        with torch.no_grad():
            along = kernel.directions.mT @ self._free(kernel.points)
            self.taken = torch.linalg.solve_triangular(kernel.factor(), along, upper=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        return self._free(x) - self.kernel.along(x) @ self.taken

    def _free(self, x: Tensor) -> Tensor:
        return side_by_side([each(x) for each in self.maps])


def _feature_maps(kernel: Kernel | None, num_inputs: int, num_features: int) -> list[Module]:
    """The feature maps of a kernel, whose features side by side are those of the kernel."""
    if kernel is None:
        return []
    if isinstance(kernel, AdditiveKernel) and kernel.active_dims is None:
        return [m for part in kernel.kernels for m in _feature_maps(part, num_inputs, num_features)]
    if isinstance(kernel, OrthogonalKernel):
        free = _feature_maps(kernel.base_kernel, num_inputs, num_features)
        return [OrthogonalFeatures(kernel, free)] if kernel.directions.shape[-1] else free
    scale = kernel if isinstance(kernel, ScaleKernel) else None
    base = kernel if scale is None else scale.base_kernel
    reads_all = base.active_dims is None and kernel.active_dims is None
    if isinstance(base, RFFKernel | ConstantKernel) and reads_all:
        return [KernelFeatures(base, scale)]
    return [gen_kernel_features(kernel, num_inputs=num_inputs, num_outputs=num_features)]


class SumFeatures(FeatureMap):
    """The features of all terms of a sum, side by side, for BoTorch's pathwise sampling."""

    input_transform = output_transform = None

    def __init__(self, kernel: SumOfTerms, num_features: int) -> None:
        super().__init__()
        self.terms: Any = kernel.terms
        features = [TermFeatures(term, num_features) for term in self.terms]
        self.features: Any = ModuleList(features)
        self.num_outputs = sum(each.num_features for each in features)
        self.batch_shape = kernel.batch_shape

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        bases = [term.weights(x) for term in self.terms]
        return weighted([each(x) for each in self.features], bases)


@GenKernelFeatures.register(SumOfTerms)  # type: ignore[untyped-decorator, unused-ignore]
def _sum_of_terms(kernel: SumOfTerms, *, num_inputs: int, num_outputs: int) -> SumFeatures:
    return SumFeatures(kernel, num_outputs)


class FunctionPerBatch(Module):
    """One function of each batch of a model, seen as so many functions of the same inputs.

    Args:
        functions: Functions of a model with ``k`` batches, one of each.
    """

    def __init__(self, functions: SampledFunctions) -> None:
        super().__init__()
        self.functions = functions

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x m``."""
        values: Tensor = self.functions(X.unsqueeze(-3))
        return values.squeeze(0).movedim(-3, 0)

    def each(self, X: Tensor) -> Tensor:
        """Evaluate each function at points of its own, ``k x q x d``: ``k x q x m``."""
        values: Tensor = self.functions(X)
        return values.squeeze(0)


def draw_functions(model: Any, num_functions: int, seed: int | None, num_features: int) -> Module:
    """Draw functions from a model's posterior; see :meth:`~gpadjust.CKA.sample_functions`."""
    check_number(num_functions, "num_functions")
    check_num_features(num_features)
    seed = None if seed is None else whole_number("seed", seed)
    model.eval()
    with seeded(seed):
        if model.num_samples is None:
            return model._draw_functions(num_functions, num_features)
        order = torch.randperm(model.num_samples)
        each = take_samples(model, order[torch.arange(num_functions) % model.num_samples])
        return FunctionPerBatch(each._draw_functions(1, num_features))


def mean_functions(model: Any, most: int | None) -> Module:
    """A model's posterior means; see :meth:`~gpadjust.CKA.mean_functions`."""
    if most is not None:
        check_number(most, "most")
    model.eval()
    if model.num_samples is None:
        return model._mean_functions()
    taken = model.num_samples if most is None else min(most, model.num_samples)
    each = take_samples(model, torch.arange(taken) * model.num_samples // taken)
    return FunctionPerBatch(each._mean_functions())


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Draw from PyTorch's generator, from a copy of it if there is a seed."""
    with nullcontext() if seed is None else torch.random.fork_rng(devices=[]):
        if seed is not None:
            torch.manual_seed(seed)
        yield


def check_number(number: int, name: str) -> None:
    """Raise a ValueError unless ``number`` is a whole number of at least 1."""
    if not isinstance(number, int) or isinstance(number, bool) or number < 1:
        raise ValueError(f"Expected {name} to be a whole number >= 1, got {number!r}.")


def check_num_features(number: int) -> None:
    """Raise a ValueError unless random features may be so many."""
    check_number(number, "num_features")
    if number % 2:
        raise ValueError(f"Expected num_features to be even (sines and cosines), got {number}.")
