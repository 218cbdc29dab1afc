"""Functions drawn from the posterior of a Gaussian process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from copy import deepcopy
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from botorch.sampling.pathwise import draw_kernel_feature_paths, draw_matheron_paths
from botorch.sampling.pathwise.features import FeatureMap, gen_kernel_features
from torch import Size, Tensor
from torch.nn import Module

if TYPE_CHECKING:
    from gpadjust.models.multi_output_gp import MultiOutputGP


class SampledFunctions(Module):
    """Deterministic functions from a posterior, by Matheron's rule (Wilson et al. 2020).

    Each is a function from the prior, on random Fourier features, plus the exact update that makes
    it meet the data. They can be called anywhere, so that particles that follow one of them stay
    consistent along a trajectory; gradients flow to the inputs as far as f_p allows.

    Args:
        model: The model; later changes of it have no effect here.
        num_functions: Number ``k`` of functions.
        num_features: Number of random features of each stationary kernel.
    """

    def __init__(self, model: MultiOutputGP, num_functions: int, num_features: int) -> None:
        super().__init__()
        model = deepcopy(model).requires_grad_(False).eval()
        draw = partial(
            draw_kernel_feature_paths,
            num_features=num_features,
            weight_generator=_normal,
            map_generator=partial(_features, model.train_inputs[0].shape[-1]),
        )
        with torch.no_grad():
            self.paths = draw_matheron_paths(model, Size([num_functions]), prior_sampler=draw)
        self.batch_shape = model.batch_shape
        self.has_outputs = model.num_outputs > 1

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x m``."""
        batch = self.batch_shape
        lead = torch.broadcast_shapes(X.shape[:-2], batch)
        extra = len(lead) - len(batch)
        # BoTorch's paths take one list of points per batch.
        count = lead[:extra].numel()
        points = X.expand(*lead, *X.shape[-2:]).reshape(count, *batch, *X.shape[-2:])
        points = points.movedim(0, -3).flatten(-3, -2)
        values = self.paths(points.unsqueeze(-3) if self.has_outputs else points)
        values = values.mT if self.has_outputs else values.unsqueeze(-1)
        values = values.unflatten(-2, (count, X.shape[-2])).movedim(-3, 1)
        return values.reshape(values.shape[0], *lead[:extra], *values.shape[2:])

    def each(self, X: Tensor) -> Tensor:
        """Evaluate each function at points of its own.

        Args:
            X: Raw inputs, ``k x q x d``; of a model without a batch shape.

        Returns:
            ``k x q x m``: the i-th function at the i-th block of points.
        """
        values: Tensor = self.paths(X.unsqueeze(-3) if self.has_outputs else X)
        return values.mT if self.has_outputs else values.unsqueeze(-1)


class FunctionPerBatch(Module):
    """One function of each batch of a model, seen as so many functions of the same inputs.

    Args:
        functions: Maps ``... x k x q x d`` to ``1 x ... x k x q x m`` in ``k`` batches.
    """

    def __init__(self, functions: Module) -> None:
        super().__init__()
        self.functions = functions

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x m``."""
        values: Tensor = self.functions(X.unsqueeze(-3))
        return values.squeeze(0).movedim(-3, 0)


def _features(num_transformed: int, *, num_inputs: int, **options: Any) -> FeatureMap:
    """A kernel's features; BoTorch counts the inputs before their transform."""
    return gen_kernel_features(num_inputs=num_transformed, **options)


def _normal(shape: Size) -> Tensor:
    return torch.randn(shape, dtype=torch.float64)


@contextmanager
def seeded(seed: int | None) -> Iterator[None]:
    """Draw from PyTorch's generator, from a copy of it if there is a seed."""
    with nullcontext() if seed is None else torch.random.fork_rng(devices=[]):
        if seed is not None:
            torch.manual_seed(seed)
        yield


def check_number(number: int, name: str) -> None:
    """Raise a ValueError unless ``number`` is a whole number of at least 1."""
    if not isinstance(number, int) or number < 1:
        raise ValueError(f"Expected {name} to be a whole number >= 1, got {number!r}.")
