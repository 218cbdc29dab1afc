"""Feature maps of this library's kernels, for BoTorch's pathwise sampling.

Importing this module registers them, so that ``draw_kernel_feature_paths``,
``draw_matheron_paths`` and ``MatheronPathModel`` of BoTorch take the models of this library, and
sums of kernels in general.
"""

from __future__ import annotations

import torch
from botorch.sampling.pathwise.features import FeatureMap, gen_kernel_features
from botorch.sampling.pathwise.features.generators import GenKernelFeatures
from gpytorch.kernels import AdditiveKernel, ConstantKernel
from torch import Size, Tensor
from torch.nn import ModuleList

from gpadjust.gp.fourier import FourierKernel
from gpadjust.gp.inputs_kernel import InputsKernel
from gpadjust.gp.physics_scaled_kernel import PhysicsScaledKernel


class PlainFeatureMap(FeatureMap):
    """A feature map without transforms around it.

    Args:
        num_outputs: Number of features.
        batch_shape: The batch shape of the kernel.
    """

    input_transform = None
    output_transform = None

    def __init__(self, num_outputs: int, batch_shape: Size) -> None:
        super().__init__()
        self.num_outputs = num_outputs
        self.batch_shape = batch_shape


class InputsFeatures(PlainFeatureMap):
    """Features of the leading columns, for :class:`~gpadjust.gp.InputsKernel`."""

    def __init__(self, kernel: InputsKernel, num_features: int) -> None:
        base = features_of(kernel.base_kernel, kernel.num_inputs, num_features)
        super().__init__(base.num_outputs, kernel.batch_shape)
        self.base = base
        self.num_inputs = kernel.num_inputs

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        features: Tensor = self.base(x[..., : self.num_inputs])
        return features


class PhysicsScaledFeatures(PlainFeatureMap):
    r"""The features :math:`f_p(x) \varphi_\rho(x)`, for ``PhysicsScaledKernel``."""

    def __init__(self, kernel: PhysicsScaledKernel, num_inputs: int, num_features: int) -> None:
        base = features_of(kernel.base_kernel, num_inputs, num_features)
        super().__init__(base.num_outputs, kernel.batch_shape)
        self.base = base
        self.physics = kernel.physics
        self.active_dims = kernel.active_dims

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        if self.active_dims is not None:
            x = x.index_select(-1, self.active_dims)
        features: Tensor = self.physics(x).unsqueeze(-1) * self.base(x)
        return features


class FourierFeatureMap(PlainFeatureMap):
    """The features that a :class:`~gpadjust.gp.FourierKernel` is made of, exactly."""

    def __init__(self, kernel: FourierKernel) -> None:
        super().__init__(kernel.features.phases.numel(), kernel.batch_shape)
        self.kernel = kernel

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        if self.kernel.active_dims is not None:
            x = x.index_select(-1, self.kernel.active_dims)
        return self.kernel.feature_map(x)


class ConstantFeature(PlainFeatureMap):
    """The root of the variance, the one feature of a ``ConstantKernel``."""

    def __init__(self, kernel: ConstantKernel) -> None:
        super().__init__(1, kernel.batch_shape)
        self.kernel = kernel

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x 1``."""
        root: Tensor = self.kernel.constant.sqrt().unsqueeze(-1)
        shape = torch.broadcast_shapes(self.batch_shape, x.shape[:-2])
        return root.expand(*shape, x.shape[-2], 1)


class JoinedFeatures(PlainFeatureMap):
    """The features of the terms side by side, for a sum of kernels."""

    def __init__(self, kernel: AdditiveKernel, num_inputs: int, num_features: int) -> None:
        maps = [features_of(term, num_inputs, num_features) for term in kernel.kernels]
        super().__init__(sum(term.num_outputs for term in maps), kernel.batch_shape)
        self.maps = ModuleList(maps)

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        return joined([term(x) for term in self.maps])


def joined(features: list[Tensor]) -> Tensor:
    """Concatenate features ``... x n x D_i`` of broadcastable batch shapes."""
    shape = torch.broadcast_shapes(*(part.shape[:-1] for part in features))
    return torch.cat([part.expand(*shape, part.shape[-1]) for part in features], dim=-1)


def features_of(kernel: object, num_inputs: int, num_features: int) -> FeatureMap:
    """Make the feature map of a kernel; see BoTorch's ``gen_kernel_features``."""
    return gen_kernel_features(kernel, num_inputs=num_inputs, num_outputs=num_features)


@GenKernelFeatures.register(InputsKernel)  # type: ignore[untyped-decorator, unused-ignore]
def _inputs(kernel: InputsKernel, *, num_inputs: int, num_outputs: int) -> InputsFeatures:
    return InputsFeatures(kernel, num_outputs)


@GenKernelFeatures.register(PhysicsScaledKernel)  # type: ignore[untyped-decorator, unused-ignore]
def _physics_scaled(
    kernel: PhysicsScaledKernel, *, num_inputs: int, num_outputs: int
) -> PhysicsScaledFeatures:
    return PhysicsScaledFeatures(kernel, num_inputs, num_outputs)


@GenKernelFeatures.register(FourierKernel)  # type: ignore[untyped-decorator, unused-ignore]
def _fourier(kernel: FourierKernel, *, num_inputs: int, num_outputs: int) -> FourierFeatureMap:
    return FourierFeatureMap(kernel)


@GenKernelFeatures.register(ConstantKernel)  # type: ignore[untyped-decorator, unused-ignore]
def _constant(kernel: ConstantKernel, *, num_inputs: int, num_outputs: int) -> ConstantFeature:
    return ConstantFeature(kernel)


@GenKernelFeatures.register(AdditiveKernel)  # type: ignore[untyped-decorator, unused-ignore]
def _sum(kernel: AdditiveKernel, *, num_inputs: int, num_outputs: int) -> JoinedFeatures:
    return JoinedFeatures(kernel, num_inputs, num_outputs)
