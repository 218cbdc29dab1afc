"""The noise of observations, whatever likelihood says it."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood, GaussianLikelihood
from gpytorch.likelihoods.noise_models import _HomoskedasticNoiseBase
from linear_operator.operators import DiagLinearOperator
from torch import Tensor
from torch.nn import Parameter


class Noise(NamedTuple):
    """The noise of observations by a GPyTorch likelihood; only this class asks the likelihood.

    Learnt variances are the one of ``GaussianLikelihood``, or those that a likelihood with a method
    ``selection`` (as that of :class:`~gpadjust.AR1`) selects from by the inputs.
    """

    likelihood: Any

    @property
    def is_known(self) -> bool:
        """True if the noise of each training target was given."""
        return isinstance(self.likelihood, FixedNoiseGaussianLikelihood)

    @property
    def known(self) -> Tensor | None:
        """The given variances of the training targets, ``... x n``, if nothing is learnt."""
        alone = self.is_known and self.likelihood.second_noise_covar is None
        return self.likelihood.noise if alone else None

    @property
    def learnt(self) -> Parameter | None:
        """The raw parameter of ``K`` learnt variances, ``... x K``, of which each point has one."""
        has_one = type(self.likelihood) is GaussianLikelihood
        found = has_one or hasattr(self.likelihood, "selection")
        return self.likelihood.noise_covar.raw_noise if found else None

    @property
    def raw_variances(self) -> list[Parameter]:
        """The raw parameters of all variances that may be learnt, beside known ones, too."""
        parts = self.likelihood.modules()
        return [part.raw_noise for part in parts if isinstance(part, _HomoskedasticNoiseBase)]

    def selection(self, inputs: Tensor) -> Tensor | None:
        """Return the share of each variance at ``n`` inputs, ``... x n x K``; None for one."""
        select = getattr(self.likelihood, "selection", None)
        return None if select is None else select(inputs)

    def at(self, inputs: Tensor, **given: Tensor) -> Tensor:
        """The variances at transformed inputs ``... x n x d``, ``... x n``.

        Where noise is known, ``noise`` gives the variances of new observations.
        """
        if type(self.likelihood) is GaussianLikelihood and not given:
            noise = self.likelihood.noise
            return noise.expand(torch.broadcast_shapes(inputs.shape[:-1], noise.shape))
        nothing = torch.zeros_like(inputs[..., 0])
        silent = MultivariateNormal(nothing, DiagLinearOperator(nothing))
        noisy = self.likelihood(silent, [inputs], **given)
        return noisy.lazy_covariance_matrix.diagonal(dim1=-1, dim2=-2)

    def typical(self, observed: Tensor) -> Tensor:
        """The mean of the given variances of observations, ``... x n`` booleans: ``... x 1``."""
        noise = self.likelihood.noise * observed
        return noise.sum(-1, keepdim=True) / observed.sum(-1, keepdim=True)

    def after(self, **given: Tensor) -> Noise:
        """Return the noise of the model conditioned on further observations."""
        return Noise(self.likelihood.get_fantasy_likelihood(**given))
