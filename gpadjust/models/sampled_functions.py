"""Functions drawn from the posterior of a sum of terms, to be called anywhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from copy import deepcopy
from threading import RLock
from typing import Any

import torch
from torch import Size, Tensor
from torch.nn import Module, ModuleDict

from gpadjust.checks import checked_whole
from gpadjust.gp import SumOfTerms, WeightedSum
from gpadjust.gp.features import term_features

DRAWING = RLock()
"""Held by the thread that draws functions, as the generator is the process's."""


class SampledFunctions(Module):
    r"""Deterministic functions from a posterior, by Matheron's rule (Wilson et al. 2020).

    Each is a function from the prior, on random Fourier features :math:`\varphi` of the terms times
    their bases, plus the exact update that makes it meet the data,

    .. math:: f(x) = m(x) + \varphi(x)^T w + k(x, X) v, \quad
        v = K^{-1} (y - f_{prior}(X) - \varepsilon).

    Gradients flow to the inputs as far as f_p allows, which is evaluated once a call.

    Args:
        model: The model; later changes of it have no effect here.
        features: The features of each term, by its name.
        weights: w, ``k x batch_shape x (m) x D``.
        train: Where the data are, if there are any for an update.
        update: v, ``k x batch_shape x (m) x n``.
        alpha: v of the mean, ``1 x batch_shape x (m) x n``, for functions to be farther from it
            where the model's variances are larger than the kernels'.
    """

    shift: Tensor
    scale: Tensor
    weights: Tensor
    points: Tensor | None
    update: Tensor
    alpha: Tensor | None

    def __init__(
        self,
        model: Any,
        features: ModuleDict,
        weights: Tensor,
        train: Tensor | None = None,
        update: Tensor | None = None,
        alpha: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.input_transform = deepcopy(getattr(model, "input_transform", None))
        self.link = model.link
        self.has_outputs = model.num_outputs > 1
        self.batch_shape: Size = model.batch_shape
        # Together, as the features read the kernels of the terms.
        self.sum, self.features = deepcopy((SumOfTerms(model.terms), features))
        self._reached = {term.name for term in model.covar_module.terms}
        tensors = (*model.units(), weights, update, train, alpha)
        names = ("shift", "scale", "weights", "update", "points", "alpha")
        for name, tensor in zip(names, tensors, strict=True):
            self.register_buffer(name, tensor)
        self.errors = None if alpha is None else deepcopy(model.larger_errors)
        self.requires_grad_(False).eval()
        self._data: WeightedSum | None = None

    @classmethod
    def by_matheron(cls, model: Any, num_functions: int, num_features: int) -> SampledFunctions:
        """Draw ``k`` functions of each batch of a model from its posterior."""
        conditioning = model.conditioning()
        (train,) = conditioning.train_inputs
        with torch.no_grad():
            features: Any = term_features(model.terms, num_features)
            shape = (num_functions, *model._aug_batch_shape)
            sizes = [each.num_features for each in features.values()]
            drawn = [torch.randn(*shape, size, dtype=torch.float64) for size in sizes]
            weights = torch.cat(drawn, dim=-1).to(train)
            prior = cls(model, features, weights)._values(train, among_reached=True)
            update = conditioning.pathwise_update(prior)
            farther = model.larger_errors is not None
            alpha = conditioning.mean_cache.unsqueeze(0) if farther else None
            return cls(model, features, weights, train, update, alpha)

    @classmethod
    def mean(cls, model: Any) -> SampledFunctions:
        """The posterior mean of each batch of a model, as a single function."""
        conditioning = model.conditioning()
        with torch.no_grad():
            alpha = conditioning.mean_cache.unsqueeze(0)
            features = term_features(model.terms, 0)
            return cls(model, features, alpha[..., :0], conditioning.train_inputs[0], alpha)

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x m``."""
        lead = torch.broadcast_shapes(X.shape[:-2], self.batch_shape)
        extra = len(lead) - len(self.batch_shape)
        return self._at(X.expand(*lead, *X.shape[-2:]), extra)

    def each(self, X: Tensor) -> Tensor:
        """Evaluate each function at points of its own, ``k x q x d``: ``k x q x m``.

        Of a model without a batch shape; a ValueError if ``X`` has another shape.
        """
        check_each(X, len(self.weights))
        return self._at(X)

    def _at(self, X: Tensor, extra: int = 0) -> Tensor:
        X = X.unsqueeze(-3) if self.has_outputs else X
        inputs = X if self.input_transform is None else self.input_transform(X)
        values = self._values(inputs, extra) * self.scale + self.shift
        values = values if self.link is None else self.link.inverse(values)
        return values.mT if self.has_outputs else values.unsqueeze(-1)

    def _values(self, inputs: Tensor, extra: int = 0, among_reached: bool = False) -> Tensor:
        """The functions in model units, ``k x ... x (m) x q``, at ``... x (m) x q x (d + k)``.

        ``extra`` dimensions of the inputs lead those of the model.
        """
        sought = self.sum.at(inputs, self._reached if among_reached else None)
        parts = self.weights.split([each.num_features for each in self.features.values()], dim=-1)
        values = {
            term.name: term.mean + _product(self.features[term.name](inputs), weights, extra)
            for (term, _), weights in zip(sought.parts, parts, strict=False)
        }
        total = sought.combine(values)
        if self.points is not None:
            if self._data is None or self._data.x is not self.points:  # also after .to(device)
                self._data = self.sum.at(self.points, self._reached)
            cross = sought.cross(self._data, is_data=True)
            total = total + _product(cross, self.update, extra)
            if self.errors is not None and self.alpha is not None:
                means = sought.combine({term.name: term.mean for term, _ in sought.parts})
                mean = means + _product(cross, self.alpha, extra)
                x = inputs[..., : self.errors.points.shape[-1]]
                total = mean + self.errors(x).sqrt() * (total - mean)
        return total


def _product(matrix: Tensor, vectors: Tensor, extra: int) -> Tensor:
    """Matrices ``extra x ... x q x n`` times vectors ``k x ... x n``: ``k x extra x ... x q``."""
    if not extra and matrix.dim() == vectors.dim():
        # One matrix for all k, which would be copied for each.
        return (matrix @ vectors.movedim(0, -1)).movedim(-1, 0)
    vectors = vectors.reshape(vectors.shape[0], *[1] * extra, *vectors.shape[1:])
    return (matrix @ vectors.unsqueeze(-1)).squeeze(-1)


class FunctionPerBatch(Module):
    """One function of each of ``k`` batches of a model, as ``k`` functions of the same inputs."""

    def __init__(self, functions: SampledFunctions) -> None:
        super().__init__()
        self.functions = functions

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x m``."""
        values: Tensor = self.functions(X.unsqueeze(-3))
        return values.squeeze(0).movedim(-3, 0)

    def each(self, X: Tensor) -> Tensor:
        """Evaluate each function at points of its own, ``k x q x d``: ``k x q x m``."""
        check_each(X, self.functions.batch_shape[0])
        values: Tensor = self.functions(X)
        return values.squeeze(0)


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Draw from PyTorch's generator of the CPU, from a copy of it if there is a seed."""
    with nullcontext() if seed is None else torch.random.fork_rng(devices=[]):
        if seed is not None:
            torch.default_generator.manual_seed(seed)  # those of GPUs are no copies
        yield


def check_each(X: Tensor, number: int) -> None:
    """Raise a ValueError unless ``X`` has points for each of so many functions."""
    if X.dim() != 3 or len(X) != number:
        raise ValueError(
            f"Expected points for each of {number} functions, {number} x q x d, got shape "
            f"{tuple(X.shape)}; the functions themselves take points that are the same for all."
        )


def check_num_features(number: int) -> None:
    """Raise a ValueError unless random features may be so many."""
    checked_whole("num_features", number, 1)
    if number % 2:
        raise ValueError(f"Expected num_features to be even (sines and cosines), got {number}.")
