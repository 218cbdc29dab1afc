"""Random features of terms, for functions drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from botorch.sampling.pathwise.features import FeatureMap, gen_kernel_features
from botorch.sampling.pathwise.features.generators import GenKernelFeatures
from gpytorch.kernels import AdditiveKernel, ConstantKernel, Kernel, RFFKernel, ScaleKernel
from torch import Tensor
from torch.nn import Module, ModuleDict, ModuleList

from gpadjust.gp.categories import OffsetFeatures, OffsetKernel
from gpadjust.gp.orthogonal_kernel import OrthogonalKernel
from gpadjust.gp.term import SumOfTerms, Term, side_by_side
from gpadjust.gp.vanishing_kernel import VanishingKernel


class TermFeatures(Module):
    """Features of a term: ``num_features`` of each stationary kernel; with 0, none of any."""

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
        return side_by_side(parts) if parts else x[..., :0]


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


class VanishingFeatures(Module):
    """The features of a ``VanishingKernel``: those of its base kernel, less what they are there."""

    def __init__(self, kernel: VanishingKernel, maps: Sequence[Module]) -> None:
        super().__init__()
        self.kernel = kernel
        self.maps = ModuleList(maps)

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        weights = self.kernel.weights(x).movedim(-1, 0).unsqueeze(-1)  # p x ... x n x 1
        there = side_by_side([each(self.kernel.moved(x)) for each in self.maps])
        return side_by_side([each(x) for each in self.maps]) - (weights * there).sum(0)


def _feature_maps(kernel: Kernel | None, num_inputs: int, num_features: int) -> list[Module]:
    """The feature maps of a kernel, whose features side by side are those of the kernel."""
    if kernel is None:
        return []
    if isinstance(kernel, AdditiveKernel) and kernel.active_dims is None:
        return [m for part in kernel.kernels for m in _feature_maps(part, num_inputs, num_features)]
    if hasattr(kernel, "features"):
        return [kernel.features(num_features)]
    if isinstance(kernel, OrthogonalKernel):
        free = _feature_maps(kernel.base_kernel, num_inputs, num_features)
        return [OrthogonalFeatures(kernel, free)] if kernel.directions.shape[-1] else free
    if isinstance(kernel, VanishingKernel):
        free = _feature_maps(kernel.base_kernel, num_inputs, num_features)
        return [VanishingFeatures(kernel, free)]
    scale = kernel if isinstance(kernel, ScaleKernel) else None
    base = kernel if scale is None else scale.base_kernel
    reads_all = base.active_dims is None and kernel.active_dims is None
    if isinstance(base, OffsetKernel):
        return [OffsetFeatures(base, scale)]
    if isinstance(base, RFFKernel | ConstantKernel) and reads_all:
        return [KernelFeatures(base, scale)]
    try:
        return [gen_kernel_features(kernel, num_inputs=num_inputs, num_outputs=num_features)]
    except NotImplementedError as error:
        raise NotImplementedError(
            f"Functions are drawn on random features, and BoTorch has none of {type(base).__name__}"
            ". Take an RBF or Matern kernel, or register features of yours with "
            "botorch.sampling.pathwise.features.generators.GenKernelFeatures."
        ) from error


class SumFeatures(FeatureMap):
    """The features of all terms of a sum, side by side, for BoTorch's pathwise sampling."""

    input_transform = output_transform = None

    def __init__(self, kernel: SumOfTerms, num_features: int) -> None:
        super().__init__()
        self.kernel = kernel
        self.maps = term_features(kernel.terms, num_features)
        sizes: list[Any] = [each.num_features for each in self.maps.values()]
        self.num_outputs = sum(sizes)
        self.batch_shape = kernel.batch_shape

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        return self.kernel.at(x).features(self.maps)


def term_features(terms: Sequence[Term], num_features: int) -> Any:
    """Random features of terms, by their names; see :class:`TermFeatures`."""
    return ModuleDict({term.name: TermFeatures(term, num_features) for term in terms})


@GenKernelFeatures.register(SumOfTerms)  # type: ignore[untyped-decorator, unused-ignore]
def _sum_of_terms(kernel: SumOfTerms, *, num_inputs: int, num_outputs: int) -> SumFeatures:
    return SumFeatures(kernel, num_outputs)
