"""What BoTorch's pathwise sampling needs to know of AR1; importing this module registers it."""

from __future__ import annotations

from typing import Any

from botorch.sampling.pathwise.features.generators import GenKernelFeatures
from botorch.sampling.pathwise.paths import GeneralizedLinearPath
from botorch.sampling.pathwise.update_strategies import GaussianUpdate
from gpytorch.likelihoods.gaussian_likelihood import _GaussianLikelihoodBase
from torch import Tensor

from gpadjust.gp.feature_maps import PlainFeatureMap, features_of, joined
from gpadjust.models.ar1 import AR1, AR1Kernel, LevelLikelihood


class AR1Features(PlainFeatureMap):
    r"""The features :math:`[\rho^{[l=1]} \varphi_1(x), \; [l=1] \varphi_\delta(x)]`."""

    def __init__(self, kernel: AR1Kernel, num_inputs: int, num_features: int) -> None:
        low = features_of(kernel.low_kernel, num_inputs, num_features)
        delta = features_of(kernel.delta_kernel, num_inputs, num_features)
        super().__init__(low.num_outputs + delta.num_outputs, kernel.batch_shape)
        self.kernel, self.low, self.delta = kernel, low, delta

    def forward(self, x: Tensor) -> Tensor:
        """Return ``... x n x D``."""
        high = x[..., -1:]
        scale = 1 + high * (self.kernel.rho.unsqueeze(-1) - 1)
        return joined([scale * self.low(x), high * self.delta(x)])


@GenKernelFeatures.register(AR1Kernel)  # type: ignore[untyped-decorator, unused-ignore]
def _ar1(kernel: AR1Kernel, *, num_inputs: int, num_outputs: int) -> AR1Features:
    return AR1Features(kernel, num_inputs, num_outputs)


@GaussianUpdate.register(AR1, LevelLikelihood)  # type: ignore[untyped-decorator, unused-ignore]
def _update(model: AR1, likelihood: LevelLikelihood, **kwargs: Any) -> GeneralizedLinearPath:
    """As BoTorch's, with the noise of each point's level."""
    (inputs,) = model.train_inputs
    noise = likelihood._shaped_noise_covar(inputs.shape[:-1], inputs)
    update = GaussianUpdate.dispatch(type(model), _GaussianLikelihoodBase)
    return update(model, likelihood, noise_covariance=noise, **kwargs)
