"""Functions drawn from the posterior of a model, to be called anywhere."""

from __future__ import annotations

from typing import Any

import torch
from botorch.sampling.pathwise import SamplePath
from torch import Size, Tensor

from gpadjust.checks import checked_whole
from gpadjust.core.kernels import Features
from gpadjust.core.terms import WeightedSum
from gpadjust.core.unknowns import standard_normal


class Functions(torch.nn.Module):
    r"""Deterministic functions from a posterior, by Matheron's rule (Wilson et al. 2020).

    Each is a function from the prior, on random features :math:`\varphi` of the terms, plus an
    update by the data:

    .. math:: f(x) = m(x) + \varphi(x)^T w + k(x, X) v, \quad
        v = K^{-1} (y - f_{prior}(X) - \varepsilon).

    The ``k`` functions are spread over the draws of the model; later changes of it have no effect.
    """

    @torch.no_grad()
    def __init__(self, model: Any, number: int, num_features: int, seed: int) -> None:
        super().__init__()
        checked_whole("num_functions", number, 1)
        if checked_whole("num_features", num_features, 2) % 2:
            raise ValueError(f"Expected an even number of features; found {num_features}.")
        generator = torch.Generator().manual_seed(seed)
        rows = torch.randperm(len(model.u), generator=generator)
        if len(rows) > 1:  # a single draw is conditioned once
            rows = rows[torch.arange(number) % len(rows)]
        self.model = model.subset_draws(rows).requires_grad_(False)
        self.number = number
        self.data = self.model.conditioning()
        f = self.data.train
        self.features: dict[str, Features] = {}
        for term in f.terms:
            if term.kernel is not None:
                values = {n: v.expand(number, *v.shape[1:]) for n, v in f.own(term).items()}
                self.features[term.name] = term.kernel.features(values, num_features, generator)
        size = f.features(self.features).shape[-1]
        # w ~ N(0, I), and v
        self.weights = standard_normal((number, model.num_outputs, size), generator, f.x)
        self.update = self.data.update(self._prior(f), generator)

    def forward(self, X: Tensor) -> Tensor:
        """Return the values ``k x ... x q x m`` of all functions at ``... x q x d``."""
        X = self.model.data.new_inputs(X)
        return self._values(self.model.evaluate(X, self.data.train.values)).movedim(-3, 0)

    def evaluate_each(self, X: Tensor) -> Tensor:
        """Return the values ``k x q x m`` of each function at other points, ``k x q x d``."""
        X = self.model.data.new_inputs(X)
        if X.dim() != 3 or len(X) != self.number:
            expected = f"points for each of {self.number} functions, {self.number} x q x d"
            raise ValueError(f"Expected {expected}; found {tuple(X.shape)}.")
        return self._values(self.model.evaluate_each(X, self.data.train.values))

    def _values(self, f: WeightedSum) -> Any:
        """Return the functions at the places of a sum, ``... x k x q x m``."""
        cross = f.cross(self.data.train) * self.data.observed.unsqueeze(-2)
        # m(x) + phi(x)^T w + k(x, X) v
        values = self._prior(f) + (cross @ self.update.unsqueeze(-1)).squeeze(-1)
        return self.model.off_gaussian_scale((values * self.model.unit).mT)

    def _prior(self, f: WeightedSum) -> Tensor:
        """Return the functions from the prior, ``... x k x m x q``."""
        return f.mean + (f.features(self.features) @ self.weights.unsqueeze(-1)).squeeze(-1)


class Paths(SamplePath):
    """Functions with the shapes of BoTorch's pathwise samples: ``sample_shape x ... x (m) x q``."""

    def __init__(self, functions: Functions, sample_shape: Size) -> None:
        super().__init__()
        self.functions, self.sample_shape = functions, sample_shape

    def set_ensemble_as_batch(self, ensemble_as_batch: bool) -> None:
        """Do nothing, as the draws of a model are no batch."""

    def forward(self, X: Tensor, **_: Any) -> Tensor:
        """Return the values at ``... x q x d``.

        Dimensions of samples in X, in front or next to the points, are points of each function.
        """
        if self.functions.model.num_outputs > 1 and X.dim() > 2 and X.shape[-3] == 1:
            X = X.squeeze(-3)  # the dimension of outputs
        lead, batch = len(self.sample_shape), X.dim() - 2
        first, last = [*range(lead)], [*range(batch - lead, batch)]
        is_inner = batch > lead and X.shape[batch - lead : batch] == self.sample_shape
        if is_inner:
            X = X.movedim(last, first)
        if X.shape[:lead] == self.sample_shape and batch >= lead:
            points = X.reshape(self.functions.number, -1, X.shape[-1])
            values = self.functions.evaluate_each(points).unflatten(1, X.shape[lead:-1])
        else:
            values = self.functions(X)
        values = values.reshape(*self.sample_shape, *values.shape[1:])
        if is_inner:
            values = values.movedim(first, last)
        return values.squeeze(-1) if values.shape[-1] == 1 else values.mT
