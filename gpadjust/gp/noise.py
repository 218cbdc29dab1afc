"""The noise of observations, whatever likelihood says it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood, GaussianLikelihood
from gpytorch.likelihoods.noise_models import _HomoskedasticNoiseBase
from linear_operator.operators import DiagLinearOperator
from torch import Size, Tensor
from torch.nn import Module, Parameter
from torch.nn.functional import pad


class RowSource:
    """A reason why the noise of training rows differs from that of new observations there."""

    has_outliers: ClassVar[bool] = False

    def refine(self, model: Any, rows: RowNoise) -> bool:
        """Set ``rows`` by what a model shows after a rough fit; return whether to fit again."""
        return False

    def confirm(self, model: Any, rows: RowNoise) -> bool:
        """The same after the fit that was asked for, which is made once more at most."""
        return False


class RowNoise(Module):
    """The noise of the training rows, beside that of new observations at their inputs.

    A submodule ``rows`` of any likelihood. Rows that came later than the training data have the
    noise of new observations.

    Args:
        sources: The reasons, which set ``added`` or ``errors`` between fits.
        shape: ``batch_shape x (m) x n``.

    Attributes:
        added: What is added to the variance of each training target, in the square of the model's
            units, of this shape (of a model that holds samples ``S x`` it).
        errors: The same of outliers, which hardly count; zero for others.
    """

    added: Tensor
    errors: Tensor

    def __init__(self, sources: Sequence[RowSource], shape: Size) -> None:
        super().__init__()
        self.sources = sources
        self.register_buffer("added", torch.zeros(shape, dtype=torch.float64))
        self.register_buffer("errors", torch.zeros(shape, dtype=torch.float64))

    @property
    def outlying(self) -> Tensor:
        """Mask of the outliers, of the shape of ``errors``."""
        return self.errors > 0

    def forget(self) -> None:
        """Let training rows have the noise of new observations."""
        self.added, self.errors = torch.zeros_like(self.added), torch.zeros_like(self.errors)

    def refine(self, model: Any) -> bool:
        """Let each source set the noise of rows after a rough fit; return whether to fit again."""
        return sum(source.refine(model, self) for source in self.sources) > 0

    def confirm(self, model: Any) -> bool:
        """The same after the fit that was asked for."""
        return sum(source.confirm(model, self) for source in self.sources) > 0


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

    @property
    def rows(self) -> RowNoise | None:
        """What tells the training rows from new observations, or None."""
        rows: RowNoise | None = getattr(self.likelihood, "rows", None)
        return rows

    def of_rows(self, variances: Tensor, kept: Any = slice(None)) -> Tensor:
        """The variances of training targets (those ``kept``) and of targets that came later.

        Args:
            variances: Those of new observations there, ``... x n``.
            kept: Which rows of the training data these are.
        """
        if self.rows is None:
            return variances
        beside = (self.rows.added + self.rows.errors)[..., kept]
        return variances + pad(beside, (0, variances.shape[-1] - beside.shape[-1]))

    def trusted(self, values: Tensor) -> Tensor:
        """Values at the training rows, ``... x (m) x n``, with NaN at outliers."""
        if self.rows is None:
            return values
        later = (0, values.shape[-1] - self.rows.errors.shape[-1])
        return values.masked_fill(pad(self.rows.outlying, later), torch.nan)

    def shares(
        self, inputs: Tensor, kept: Any = slice(None)
    ) -> tuple[Tensor | None, Tensor | None]:
        """The shares of learnt variances in those of training targets, and what is added to them.

        Args:
            inputs: Transformed training inputs, or some rows of them, ``... x n x d``.
            kept: Which rows these are.

        Returns:
            ``... x n x K``, None for one variance in full; and ``... x n``, None for nothing.
        """
        beside = None if self.rows is None else (self.rows.added + self.rows.errors)[..., kept]
        return self.selection(inputs), beside

    def typical(self, observed: Tensor) -> Tensor:
        """The mean of the given variances of observations, ``... x n`` booleans: ``... x 1``."""
        noise = self.likelihood.noise * observed
        return noise.sum(-1, keepdim=True) / observed.sum(-1, keepdim=True)

    def after(self, **given: Tensor) -> Noise:
        """Return the noise of the model conditioned on further observations."""
        return Noise(self.likelihood.get_fantasy_likelihood(**given))
