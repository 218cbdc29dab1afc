"""Updates of a fitted model by single observations, at a constant cost."""

from __future__ import annotations

import math
from abc import abstractmethod
from copy import deepcopy
from typing import Any, Self

import torch
from torch import Tensor
from torch.nn import Buffer

from gpadjust.checks import checked_number, checked_whole
from gpadjust.core import GP, Fourier
from gpadjust.core.data import ArrayLike
from gpadjust.core.gaussian import Marginals
from gpadjust.core.terms import WeightedSum
from gpadjust.kinds.local_errors import Widened

_EXPECTED = 10.0  # a in the equation: observations with errors as predicted, from the start


class Updated(Widened):
    r"""A fitted model that takes observations, with the unknown numbers of the fit.

    Variances follow recent errors. With :math:`z_k^2` the squared error of the observation of age k
    over its predicted variance, and :math:`\lambda = e^{-1 / \tau}`, they are multiplied by

    .. math:: \max\Big(1, \frac{a + \sum_k \lambda^k z_k^2}{a + \sum_k \lambda^k}\Big), \quad
        a = 10.
    """

    numbers = ("recent",)
    forget: float = math.inf  # tau

    def __init__(self, model: GP) -> None:
        super().__init__(model)
        self.recent: Tensor = Buffer(model.unit.new_zeros(model.num_outputs, 2))  # both sums

    def factors(self, X: Tensor) -> Tensor:
        """Return the factors of all inputs, ``1 x m``."""
        # max(1, (a + sum_k lambda^k z_k^2) / (a + sum_k lambda^k))
        errors, number = self.recent.unbind(-1)
        return ((_EXPECTED + errors) / (_EXPECTED + number)).clamp_min(1.0).unsqueeze(0)

    @torch.no_grad()
    def update(self, X: ArrayLike, Y: ArrayLike, noise: Tensor | None = None) -> Self:
        """Update the model by observations ``k x m`` at inputs ``k x d``, the newest last.

        The variances of their noise belong to models with known ones. If data are invalid, a
        ValueError is raised, and the model is as before.
        """
        X = self.data.new_inputs(X)
        if X.dim() != 2 or not len(X):
            raise ValueError(f"Expected X of one row at least, k x d; found {tuple(X.shape)}.")
        more = self.models[-1].condition_on_observations(X, Y, noise)
        if more.batch_shape:
            raise ValueError(f"Expected Y of shape k x m; found a batch {tuple(more.batch_shape)}.")
        late = slice(-len(X), None)
        conditioning = more.conditioning()
        f = conditioning.train.of_rows(late)
        noises = conditioning.noise[..., late]
        targets = conditioning.targets[0, ..., late]
        new = self._updated(more, f, noises, targets)
        # z^2 of each observation, by the model before the update
        means, variances = self.model.conditioning().moments(f)
        mean, variance = Marginals(means.mT, (variances + noises).mT).prediction
        for squares in ((targets - mean.mT).square() / variance.mT).unbind(-1):
            last = torch.stack([squares.nan_to_num(nan=0.0), (~squares.isnan()).to(squares)], -1)
            self.recent = math.exp(-1 / self.forget) * self.recent + last
        self.models[0] = new
        return self

    @abstractmethod
    def _updated(self, more: GP, f: WeightedSum, noise: Tensor, targets: Tensor) -> GP:
        """Return the updated model; ``more`` has the new rows, with f, noise and targets there."""


class Window(Updated):
    """A model of the last observations, the attribute ``model``, in the units of the fit.

    Args:
        model: Any fitted model with an exact posterior and a noise without corrections of rows.
        size: Number of rows. Default: the number of rows of the model.

    Example:
        >>> from gpadjust.core import ZeroMeanGP
        >>> X = torch.linspace(0, 1, 9, dtype=torch.float64).unsqueeze(-1)
        >>> window = Window(ZeroMeanGP(X, X.sin()), size=5).update(X[:1] + 1.1, X[:1].cos())
        >>> len(window.data.X)
        5
    """

    def __init__(self, model: GP, size: int | None = None) -> None:
        super().__init__(model)
        self.size = checked_whole("size", len(model.data.X) if size is None else size, 2)
        self.forget = self.size

    def _updated(self, more: GP, f: WeightedSum, noise: Tensor, targets: Tensor) -> GP:
        return _of_rows(more, torch.arange(len(more.data.X))[-self.size :])


class Kalman(Updated):
    r"""A ridge regression adjustment with recursive updates of its weights.

    The posterior of the weights of the features, in units of their prior N(0, I), has the
    precision :math:`\Lambda` and the mean :math:`\Lambda^{-1} h`. For each observation
    :math:`y = \varphi^T \beta + \epsilon`, with :math:`\lambda = e^{-1 / \tau}`, old ones fade, but
    not the prior (stabilised forgetting, Kulhavy and Zarrop 1993):

    .. math:: \Lambda \leftarrow \lambda \Lambda + (1 - \lambda) I + \varphi \varphi^T / \sigma^2,
        \quad h \leftarrow \lambda h + \varphi y / \sigma^2.

    This is a Kalman filter in information form, for each draw of the model. An observation of
    :math:`k` steps ago counts as one with the noise :math:`\sigma^2 e^{k / \tau}`.

    Args:
        model: A fitted :class:`~gpadjust.RRA`, or another model whose kernels are ``Fourier``.
        forget: :math:`\tau`, in observations; infinity, the default, forgets nothing.
    """

    def __init__(self, model: GP, forget: float = math.inf) -> None:
        super().__init__(model)
        if forget != math.inf:
            checked_number("forget", forget, above=0)
        self.forget = forget
        kernels = [term.kernel for term in model.terms if term.kernel is not None]
        if not all(isinstance(kernel, Fourier) for kernel in kernels):
            raise TypeError(f"Expected an RRA; found kernels {kernels}. Take Window(model, size).")
        self.weights = Weights.condition(model)
        self.models.append(_of_rows(model, torch.arange(2)))  # checks and scales observations

    @property
    def model(self) -> GP:
        """The model with the posterior of the weights."""
        if not isinstance(self.models[0].conditioning(), Weights):  # lost by a move to a device
            self.weights = self.weights.moved_to(self.models[0])
            self.models[0] = self.models[0].with_conditioning(self.weights)
        return super().model

    def condition_on_observations(
        self, X: ArrayLike, Y: ArrayLike, noise: Tensor | None = None, **_: Any
    ) -> Self:
        """Return a copy, updated by observations ``k x d`` and ``k x m``."""
        return deepcopy(self).update(X, Y, noise)

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the model of some outputs; raise a ValueError for an unknown number."""
        new = super().subset_output(idcs)
        new.weights = self.weights.moved_to(new.models[0], idcs)
        return new

    def _updated(self, more: GP, f: WeightedSum, noise: Tensor, targets: Tensor) -> GP:
        model = self.model  # before the weights are others
        self.weights = self.weights.updated(f, noise, targets - f.mean, self.forget)
        return model.with_conditioning(self.weights)


class Weights:
    r"""The posterior of the weights of Fourier features, as the conditioning of a model."""

    def __init__(self, train: WeightedSum, precision: Tensor, pull: Tensor) -> None:
        self.train = train  # the function at the training inputs of the model
        self.precision = precision  # Lambda, S x m x p x p
        self.pull = pull  # h, S x m x p
        self.alpha = pull  # a model reads whether it has a graph
        # Lambda^-1 = R R^T, with R = L^-T and Lambda = L L^T; the mean is R R^T h.
        chol = torch.linalg.cholesky(precision)
        eye = torch.eye(chol.shape[-1]).to(chol).expand_as(chol)
        self.root = torch.linalg.solve_triangular(chol, eye, upper=False).mT
        self.mean = (self.root @ (self.root.mT @ pull.unsqueeze(-1))).squeeze(-1)

    @classmethod
    @torch.no_grad()
    def condition(cls, model: GP) -> Self:
        """Return the weights conditioned on the data of a model."""
        data = model.conditioning()
        residual = data.targets - data.train.mean
        lead = (*data.noise.shape[:-1], design(data.train).shape[-1])  # S x m x p
        eye = torch.eye(lead[-1]).to(residual).expand(*lead, -1)
        prior = cls(data.train, eye, residual.new_zeros(lead))
        return prior.updated(data.train, data.noise, residual, math.inf)

    def updated(self, f: WeightedSum, noise: Tensor, residual: Tensor, forget: float) -> Self:
        """Return the weights given further residuals ``S x m x k`` of a sum, the newest last."""
        k = residual.shape[-1]
        phi = design(f)
        # Of k observations the first has the weight lambda^(k - 1) / sigma^2, the last 1 / sigma^2.
        fading = torch.arange(k - 1, -1, -1).to(noise).div(-forget).exp()
        weight = (fading / noise).masked_fill(residual.isnan(), 0.0)
        weighted = (phi * weight.unsqueeze(-1)).mT
        # Lambda <- lambda^k Lambda + (1 - lambda^k) I + sum_i w_i phi_i phi_i^T
        share = math.exp(-k / forget)
        precision = share * self.precision + weighted @ phi
        precision.diagonal(dim1=-1, dim2=-2).add_(1 - share)
        # h <- lambda^k h + sum_i w_i phi_i r_i
        pull = share * self.pull + (weighted @ residual.nan_to_num().unsqueeze(-1)).squeeze(-1)
        return type(self)(self.train, precision, pull)

    def moments(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return means and variances at each point, ``... x S x m x q``."""
        phi = design(sought)
        mean = sought.mean + (phi @ self.mean.unsqueeze(-1)).squeeze(-1)
        return mean, (phi @ self.root).square().sum(-1)

    def joint(self, sought: WeightedSum) -> tuple[Tensor, Tensor]:
        """Return means and covariances, ``... x S x m x q x q``."""
        root = design(sought) @ self.root
        return self.moments(sought)[0], root @ root.mT

    @torch.no_grad()
    def moved_to(self, model: GP, outputs: Any = slice(None)) -> Self:
        """Return the weights for a model on another device, or of some outputs."""
        precision, pull = self.precision[:, outputs].to(model.u), self.pull[:, outputs].to(model.u)
        return type(self)(model.evaluate(model.data.X), precision, pull)


def design(f: WeightedSum) -> Tensor:
    """Return the features of a sum by its kernels, ``... x S x m x n x p``, for weights N(0, I)."""
    features = {}
    for term in f.terms:
        if term.kernel is not None:  # of fixed frequencies, which need no generator
            features[term.name] = term.kernel.features(f.own(term), 0, torch.Generator())
    return f.features(features)


def _of_rows(model: GP, rows: Tensor) -> GP:
    """Return the model of some rows; raise a ValueError if its noise belongs to all rows."""
    new = model.subset_rows(rows)
    if new is None:
        raise ValueError(f"Expected a noise without corrections of rows; found {model.noise}.")
    return new
