"""Observations that come one after the other, at a constant cost."""

from __future__ import annotations

import math
from abc import abstractmethod
from copy import deepcopy
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn import Buffer

from gpadjust.checks import checked_number, checked_whole
from gpadjust.core import GP, Fourier, MixturePosterior
from gpadjust.core.data import ArrayLike
from gpadjust.core.gaussian import Marginals
from gpadjust.core.terms import WeightedSum
from gpadjust.kinds.local_errors import Widened

_EXPECTED = 10.0  # observations that err as predicted, besides those that came


class Updated(Widened):
    r"""A fitted model that takes observations; its unknown numbers stay as they are.

    Variances follow recent errors: with :math:`z_i^2` the squared error over the predicted variance
    of what came, :math:`\lambda = e^{-1 / \tau}` and ages k, they are multiplied by

    .. math:: \max\Big(1, \frac{a + \sum_k \lambda^k z_k^2}{a + \sum_k \lambda^k}\Big), \quad
        a = 10.

    Attributes:
        recent: The two sums, ``m x 2``.
    """

    numbers = ("recent",)
    forget: float = math.inf  # tau

    def __init__(self, model: GP) -> None:
        super().__init__(model)
        self.recent: Tensor = Buffer(model.unit.new_zeros(model.num_outputs, 2))

    def factors(self, X: Tensor) -> Tensor:
        """Return the factors of all inputs, ``1 x m``."""
        errors, number = self.recent.unbind(-1)
        return ((_EXPECTED + errors) / (_EXPECTED + number)).clamp_min(1.0).unsqueeze(0)

    @torch.no_grad()
    def update(self, X: ArrayLike, Y: ArrayLike, noise: Tensor | None = None) -> Self:
        """Take observations ``k x d`` and ``k x m``, the last of which is the newest.

        Args:
            X: Inputs, as the model's training inputs.
            Y: Observations, a tensor or as them; NaN where one is missing.
            noise: Their variances, of a model with known ones.

        Raises:
            ValueError: If the model refuses them; nothing has changed then.
        """
        X = self.data.new_inputs(X)
        if X.dim() != 2 or not len(X):
            raise ValueError(f"Expected X of one row at least, k x d; found {tuple(X.shape)}.")
        more = self.models[-1].condition_on_observations(X, Y, noise)
        if more.batch_shape:
            raise ValueError(f"Expected Y of shape k x m; found a batch {tuple(more.batch_shape)}.")
        late, given = slice(-len(X), None), more.conditioning()
        f, variances = given.train.of_rows(late), given.noise[..., late]
        targets = given.targets[0, ..., late]
        new = self._updated(more, f, variances, targets)
        means, own = self.model.conditioning().marginals(f)
        mean, variance = Marginals(means.mT, (own + variances).mT).prediction
        for z in ((targets - mean.mT).square() / variance.mT).unbind(-1):
            last = torch.stack([z.nan_to_num(nan=0.0), (~z.isnan()).to(z)], -1)
            self.recent = math.exp(-1 / self.forget) * self.recent + last
        self.models[0] = new
        return self

    @abstractmethod
    def _updated(self, more: GP, f: WeightedSum, noise: Tensor, targets: Tensor) -> GP:
        """Return the model with the last rows of another, where it has a function, and targets."""


class Window(Updated):
    """A model that keeps its last observations.

    The unknown numbers and units are those of the fit. Its attribute ``model`` is the model of the
    rows that are kept, for all else that one asks.

    Args:
        model: Any fitted model with an exact posterior, whose noise can do with other rows.
        size: Number of rows. Default: as many as the model has.

    Example:
        >>> from gpadjust.core import ZeroMeanGP
        >>> X = torch.linspace(0, 1, 9, dtype=torch.float64).unsqueeze(-1)
        >>> window = Window(ZeroMeanGP(X, X.sin()), size=5).update(X[:1] + 1.1, X[:1].cos())
        >>> len(window.data.X)
        5
    """

    def __init__(self, model: GP, size: int | None = None) -> None:
        super().__init__(model)
        self.size = len(model.data.X) if size is None else checked_whole("size", size, 2)
        self.forget = self.size

    def _updated(self, more: GP, f: WeightedSum, noise: Tensor, targets: Tensor) -> GP:
        return _of_rows(more, torch.arange(len(more.data.X))[-self.size :])


class Kalman(Updated):
    r"""A ridge regression adjustment whose weights take observations, of which it keeps none.

    The posterior of the weights of the features, in units of their prior N(0, I), is known by its
    precision :math:`\Lambda` and h, of the mean :math:`\Lambda^{-1} h`. An observation
    :math:`y = \varphi^T \beta + \epsilon` adds to both; before, with
    :math:`\lambda = e^{-1 / \tau}`, what was observed fades, the prior does not (stabilised
    forgetting, Kulhavy and Zarrop 1993):

    .. math:: \Lambda \leftarrow \lambda \Lambda + (1 - \lambda) I + \varphi \varphi^T / \sigma^2,
        \quad h \leftarrow \lambda h + \varphi y / \sigma^2.

    It is a Kalman filter in its information form, for each draw of the model. An observation of
    :math:`k` steps ago counts as one with the noise :math:`\sigma^2 e^{k / \tau}`; no variance
    grows beyond the prior's.

    Args:
        model: A fitted :class:`~gpadjust.RRA`, or another model whose kernels are ``Fourier``.
        forget: :math:`\tau`, in observations; infinite for never.

    Attributes:
        model: The model with the posterior of the weights, of the same data.
    """

    def __init__(self, model: GP, forget: float = math.inf) -> None:
        super().__init__(model)
        self.forget = forget if forget == math.inf else checked_number("forget", forget, above=0)
        kernels = [term.kernel for term in model.terms if term.kernel is not None]
        if not all(isinstance(kernel, Fourier) for kernel in kernels):
            raise TypeError(f"Expected an RRA; found kernels {kernels}. Take Window(model, size).")
        self._weights = Weights.of_model(model)
        self.models.append(_of_rows(model, torch.arange(2)))  # it checks and reads observations

    @property
    def model(self) -> GP:
        """The model with the posterior of the weights, which it loses when it moves to a device."""
        if not isinstance(self.models[0].conditioning(), Weights):
            self._weights = self._weights.of(self.models[0])
            self.models[0] = self.models[0].with_conditioning(self._weights)
        return super().model

    @property
    def weights(self) -> Weights:
        """The posterior of the weights."""
        weights: Any = self.model.conditioning()
        return weights

    def term(self, name: str, X: ArrayLike) -> MixturePosterior:
        """Return the joint posterior of a term's process at ``X``, as of a GP."""
        return self.model.term(name, X)

    def condition_on_observations(
        self, X: ArrayLike, Y: ArrayLike, noise: Tensor | None = None, **_: Any
    ) -> Self:
        """Return a copy that has taken observations ``k x d`` and ``k x m``."""
        return deepcopy(self).update(X, Y, noise)

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the model of some outputs; a ValueError if there are none of these numbers."""
        new = super().subset_output(idcs)
        new._weights = self.weights.of(new.models[0], idcs)
        return new

    def _updated(self, more: GP, f: WeightedSum, noise: Tensor, targets: Tensor) -> GP:
        self._weights = self.weights.updated(f, noise, targets - f.mean, self.forget)
        return self.model.with_conditioning(self._weights)


class Weights:
    r"""The posterior of the weights of Fourier features, which conditions a model.

    It has the function at the training inputs of the model, the precision :math:`\Lambda`,
    ``S x m x p x p``, and the pull h, ``S x m x p``.
    """

    def __init__(self, train: WeightedSum, precision: Tensor, pull: Tensor) -> None:
        self.train, self.precision, self.pull = train, precision, pull
        self.alpha = pull  # a model asks whether it has a graph
        chol = torch.linalg.cholesky(precision)
        eye = torch.eye(chol.shape[-1]).to(chol).expand_as(chol)
        self.root = torch.linalg.solve_triangular(chol, eye, upper=False).mT
        self.mean = (self.root @ (self.root.mT @ pull.unsqueeze(-1))).squeeze(-1)

    @classmethod
    @torch.no_grad()
    def of_model(cls, model: GP) -> Self:
        """Return the weights given the data of a model."""
        data = model.conditioning()
        residual = data.targets - data.train.mean
        lead = (*data.noise.shape[:-1], design(data.train).shape[-1])  # S x m x p
        eye = torch.eye(lead[-1]).to(residual).expand(*lead, -1)
        prior = cls(data.train, eye, residual.new_zeros(lead))
        return prior.updated(data.train, data.noise, residual, math.inf)

    def updated(self, f: WeightedSum, noise: Tensor, residual: Tensor, forget: float) -> Self:
        """Return the weights given observations of a sum, too, the last of which is the newest.

        Variances of their noise are ``S x m x k``, and so are residuals, targets less their prior
        mean; NaN where one is missing.
        """
        k, phi = residual.shape[-1], design(f)
        left = torch.arange(k - 1, -1, -1).to(noise).div(-forget).exp()
        weight = (left / noise).masked_fill(residual.isnan(), 0.0)
        kept = math.exp(-k / forget)
        weighted = (phi * weight.unsqueeze(-1)).mT
        precision = kept * self.precision + weighted @ phi
        precision.diagonal(dim1=-1, dim2=-2).add_(1 - kept)
        pull = kept * self.pull + (weighted @ residual.nan_to_num().unsqueeze(-1)).squeeze(-1)
        return type(self)(self.train, precision, pull)

    def marginals(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return means and variances at each point, ``... x S x m x q``."""
        phi = design(sought)
        mean = sought.mean + (phi @ self.mean.unsqueeze(-1)).squeeze(-1)
        return mean, (phi @ self.root).square().sum(-1)

    def joint(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return means and covariances, ``... x S x m x q x q``."""
        root = design(sought) @ self.root
        return self.marginals(sought)[0], root @ root.mT

    @torch.no_grad()
    def of(self, model: GP, outputs: Any = slice(None)) -> Self:
        """Return the weights of a model on another device, or of some outputs."""
        parts = (each[:, outputs].to(model.u) for each in (self.precision, self.pull))
        return type(self)(model.at(model.data.X), *parts)


def design(f: WeightedSum) -> Tensor:
    """Return the kernels' own features of a sum, ``... x S x m x n x p``, for weights N(0, I)."""
    generator = torch.Generator()  # not used, as these are not random
    kernels = {term.name: term.kernel for term in f.terms if term.kernel is not None}
    own = {term.name: f.own(term) for term in f.terms}
    return f.features({n: k.features(own[n], 0, generator) for n, k in kernels.items()})


def _of_rows(model: GP, rows: Tensor) -> GP:
    """Return the model of some rows, if its noise can do with them."""
    new = model.subset_rows(rows)
    if new is None:
        raise ValueError(f"Expected a noise that can do with other rows; found {model.noise}.")
    return new
