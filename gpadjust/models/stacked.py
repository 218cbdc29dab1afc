"""A mixture of models of several structures, as a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, NamedTuple, Self

import torch
from botorch.acquisition.objective import PosteriorTransform
from botorch.models.model import Model
from botorch.models.utils import fantasize as fantasize_flag
from botorch.posteriors import Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM
from botorch.sampling import MCSampler
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood
from linear_operator import to_dense
from torch import Size, Tensor
from torch.nn import Module, ModuleList
from torch.quasirandom import SobolEngine

from gpadjust.models.exact_gp_base import ExactGPBase
from gpadjust.models.hyperparameter_samples import take_samples
from gpadjust.models.mixed_functions import MixedFunctions, OutputsSideBySide
from gpadjust.models.posteriors import (
    HyperparameterMixture,
    ScaleFreePosterior,
    mixture_interval,
    mixture_moments,
)
from gpadjust.models.sampled_functions import check_number, seeded
from gpadjust.models.terms_model import Prediction
from gpadjust.models.training_data import (
    ArrayLike,
    check_columns,
    check_finite,
    check_noise,
    check_observed,
    to_tensor,
)


class Part(NamedTuple):
    """What a structure gives to the mixture of an output.

    Attributes:
        name: The structure's name.
        model: A model of that output alone.
        number: How many of the components are its.
    """

    name: str
    model: ExactGPBase
    number: int


class StackedGP(Model):
    r"""Predictive distributions of several models, stacked: their weighted mixture.

    .. math:: p(f(x)) = \sum_k w_k \, p_k(f(x))

    (Yao et al. 2018). Each output has weights of its own. The mixture is of equally likely
    Gaussians: samples of each model's hyper-parameters, in proportion to its weight. To BoTorch it
    is a fully Bayesian model, so that acquisition functions average over the components. As outputs
    are independent, components of each structure of one meet those of all structures of another.
    :func:`~gpadjust.compare` finds the weights; the hyper-parameters stay as they are.

    Args:
        models: Fitted models of the same data, by the names of their structures.
        weights: The weight of each model for each output, ``K x m``; in all 1 for each output.
        num_components: Number ``S`` of Gaussians; weights are rounded to multiples of ``1 / S``.
            The time of a prediction grows with it, and that of some acquisition functions: the
            noisy hypervolume improvement of two outputs took 64 s with 32, and 0.4 s of a fitted
            CKA. Take fewer where that is too long.

    Attributes:
        weights: The weights of each structure, one for each output, after rounding, by its name.
        num_samples: ``S``.

    Raises:
        TypeError: If a model is none of this library, or weights are no numbers.
        ValueError: If there is no model, their data differ, or weights are of another shape,
            negative, or not 1 in all.

    Example:
        >>> import torch
        >>> from gpadjust import CKA, PhysicsMeanGP, StackedGP
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> models = {
        ...     "CKA": CKA(X, X.sin(), physics=lambda X: X),
        ...     "physics mean": PhysicsMeanGP(X, X.sin(), physics=lambda X: X),
        ... }
        >>> stacked = StackedGP(models, torch.tensor([[0.75], [0.25]]).double())
        >>> stacked.predict(X).mean.shape
        torch.Size([8, 1])
    """

    _is_fully_bayesian = _is_ensemble = True

    def __init__(
        self,
        models: Mapping[str, ExactGPBase],
        weights: Tensor | Sequence[Sequence[float]],
        num_components: int = 32,
    ) -> None:
        super().__init__()
        check_number(num_components, "num_components")
        weights = _as_weights(weights)
        first = _check(models, weights)
        self.num_samples = num_components
        self._made_of: dict[str, ExactGPBase] | None = {**models}
        self.input_names, self.output_names = first.input_names, first.output_names
        self.weights: dict[str, list[float]] = {name: [] for name in models}
        self.groups: Any = ModuleList()
        self._labels: list[list[tuple[str, int]]] = []
        self._orders: list[Tensor] = []
        orders = _orders(first.num_outputs, num_components)
        for j, share in enumerate(weights.unbind(-1)):
            counts = allocation(share, num_components)
            for name, count in zip(models, counts, strict=True):
                self.weights[name].append(count / num_components)
            used = [(name, n) for name, n in zip(models, counts, strict=True) if n]
            self.groups.append(ModuleList([_part(models[name], j, n) for name, n in used]))
            self._labels.append(used)
            self._orders.append(orders[j] if len(used) > 1 else torch.arange(num_components))
        self.eval()

    @property
    def parts(self) -> list[list[Part]]:
        """The parts of the mixture of each output."""
        pairs = zip(self._labels, self.groups, strict=True)
        return [
            [Part(name, model, n) for (name, n), model in zip(labels, group, strict=True)]
            for labels, group in pairs
        ]

    @property
    def made_of(self) -> dict[str, ExactGPBase]:
        """The models that it was made of, by the names of their structures.

        Raises:
            ValueError: If it is a subset of outputs, or was conditioned on fantasies.
        """
        if self._made_of is None:
            raise ValueError(
                "This mixture is of parts of models, a subset of their outputs or fantasies; take "
                "the StackedGP that it was made from."
            )
        return {**self._made_of}

    @property
    def num_outputs(self) -> int:
        """The number ``m`` of outputs."""
        return len(self.groups)

    @property
    def batch_shape(self) -> Size:
        """One dimension, of the components."""
        return Size([self.num_samples])

    @property
    def num_mcmc_samples(self) -> int:
        """``num_samples``, under BoTorch's name."""
        return self.num_samples

    def train(self, mode: bool = True) -> Self:
        """Put the model in eval mode; it is not trained.

        Raises:
            RuntimeError: If it is to be in train mode.
        """
        if mode:
            raise RuntimeError(
                "A StackedGP is made of fitted models, and not trained: `gpadjust.fit` its models "
                "and stack them again."
            )
        return super().train(mode)

    def __repr__(self) -> str:
        """One line; :meth:`summary` says more."""
        return f"StackedGP of {', '.join(self.weights)}: {self.num_samples} components"

    def summary(self) -> str:
        """The weights of each output, and what each of the models has learnt."""
        lines = [repr(self)]
        for name, parts in zip(self.output_names, self.parts, strict=True):
            lines += [
                f"{part.number / self.num_samples:.0%} of {name}: {part.name}, "
                f"{part.model.summary()}"
                for part in parts
            ]
        return "\n".join(lines)

    def posterior(
        self,
        X: ArrayLike,
        output_indices: list[int] | None = None,
        observation_noise: bool | Tensor = False,
        posterior_transform: PosteriorTransform | None = None,
    ) -> Posterior:
        """The joint posterior at raw ``X`` (``batch_shape x q x d``), a mixture; see BoTorch."""
        if output_indices is not None:
            subset = self.subset_output(list(output_indices))
            return subset.posterior(X, None, observation_noise, posterior_transform)
        moments = []
        for j, group in enumerate(self.parts):
            each = [
                _joint(part, part.model.posterior(X, None, _of_output(observation_noise, j)))
                for part in group
            ]
            means, covariances = zip(*each, strict=True)
            mean, covariance = torch.cat(means, -2), torch.cat(covariances, -3)
            order = self._orders[j]
            moments.append((mean[..., order, :], covariance[..., order, :, :]))
        several = self.num_outputs > 1
        mean = torch.stack([m for m, _ in moments], -2) if several else moments[0][0]
        covariance = torch.stack([c for _, c in moments], -3) if several else moments[0][1]
        posterior = HyperparameterMixture(ScaleFreePosterior.of_outputs(mean, covariance, several))
        if posterior_transform is None:
            return posterior
        return ScaleFreePosterior.transformed(posterior_transform(posterior=posterior, X=X))

    def predict(self, X: ArrayLike, observation_noise: bool | Tensor = False) -> Prediction:
        """The mixture's mean and variance at each point by itself, as :meth:`CKA.predict`.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            observation_noise: As in :meth:`CKA.predict`.

        Returns:
            ``batch_shape x q x m`` each, in the user's units.
        """
        return Prediction(*mixture_moments(*self.components(X, observation_noise)))

    def interval(
        self, X: ArrayLike, level: float = 0.95, observation_noise: bool | Tensor = False
    ) -> tuple[Tensor, Tensor]:
        """The central interval of the mixture at each point by itself, as :meth:`CKA.interval`.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            level: The probability that it holds, between 0 and 1.
            observation_noise: As in :meth:`predict`.

        Returns:
            Lower and upper ends, ``batch_shape x q x m`` each, in the user's units.

        Raises:
            ValueError: If ``level`` is not between 0 and 1.
        """
        return mixture_interval(lambda: self.components(X, observation_noise), level)

    def components(self, X: ArrayLike, observation_noise: bool | Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances of all components, ``... x S x q x m``."""
        outputs = []
        for j, group in enumerate(self.parts):
            each = [
                [
                    _for_each(moment, part.number, MCMC_DIM)
                    for moment in part.model.components(X, _of_output(observation_noise, j))
                ]
                for part in group
            ]
            outputs.append([torch.cat(parts, MCMC_DIM) for parts in zip(*each, strict=True)])
        mean, variance = (torch.cat(parts, -1) for parts in zip(*outputs, strict=True))
        return mean, variance

    def sample_functions(
        self, num_functions: int, seed: int | None = None, num_features: int = 1024
    ) -> Module:
        """Draw functions from the mixture, spread over its components.

        Arguments, result and errors are those of :meth:`CKA.sample_functions`.
        """
        check_number(num_functions, "num_functions")
        with seeded(seed):
            drawn = []
            for group in self.parts:
                owner = torch.arange(len(group)).repeat_interleave(
                    torch.tensor([part.number for part in group])
                )
                owner = owner[torch.randperm(self.num_samples)]
                owner = owner[torch.arange(num_functions) % self.num_samples]
                counts = owner.bincount(minlength=len(group)).tolist()
                functions = [
                    part.model.sample_functions(n, None, num_features) if n else Module()
                    for part, n in zip(group, counts, strict=True)
                ]
                drawn.append(MixedFunctions(functions, owner))
        return OutputsSideBySide(drawn)

    def subset_output(self, idcs: list[int]) -> Self:
        """The mixtures of some outputs; negative numbers count from the end."""
        m = self.num_outputs
        if not idcs or any(not isinstance(i, int) or not -m <= i < m for i in idcs):
            raise ValueError(
                f"Expected numbers of outputs from 0 to {m - 1} (one at least), got {idcs}."
            )
        return self._with([[*self.groups[i]] for i in idcs], idcs)

    def condition_on_observations(
        self, X: ArrayLike, Y: ArrayLike, noise: Tensor | None = None
    ) -> Self:
        """Condition each part on new observations; the weights stay.

        Args:
            X: Raw inputs, ``k x d``.
            Y: Observations, ``k x m``, in the user's units; NaN where an output was not observed.
            noise: The variances of the new observations, of the shape of ``Y``, if they are known.

        Raises:
            TypeError: As :meth:`CKA.condition_on_observations`.
            ValueError: As :meth:`CKA.condition_on_observations`.
        """
        check_columns(X, self.input_names)
        X, Y = to_tensor(X, "X"), to_tensor(Y, "Y")
        if X.dim() != 2 or Y.shape != (len(X), self.num_outputs):
            raise ValueError(
                f"Expected X of shape k x d and Y of shape k x {self.num_outputs}, got "
                f"{tuple(X.shape)} and {tuple(Y.shape)}; fantasies are made of its parts."
            )
        check_finite(X, "X")
        check_observed(Y, "Y")
        if noise is not None:
            check_noise(noise, Y)
        # An output that was not observed has the row, too, so that all have the same ones.
        groups = [
            [
                part.model.with_observations(X, Y[:, [j]], None if noise is None else noise[:, [j]])
                for part in group
            ]
            for j, group in enumerate(self.parts)
        ]
        return self._with(groups, [*range(self.num_outputs)])

    def fantasize(self, X: Tensor, sampler: MCSampler) -> Self:
        """Condition each component on observations that are drawn from it; see BoTorch.

        Args:
            X: Raw inputs, ``batch_shape x k x d``.
            sampler: Draws the observations from the posterior at ``X``.

        Raises:
            ValueError: If a part cannot hold samples, as a :class:`~gpadjust.models.PaperRRA`.
        """
        with fantasize_flag():
            Y = sampler(self.posterior(X, observation_noise=True))  # f x batch x S x k x m
            groups = []
            for j, (parts, order) in enumerate(zip(self.parts, self._orders, strict=True)):
                numbers = [part.number for part in parts]
                own = Y[..., order.argsort(), :, j].unsqueeze(-1).split(numbers, dim=-3)
                groups.append([_fantasy(p, X, y) for p, y in zip(parts, own, strict=True)])
        return self._with(groups, [*range(self.num_outputs)])

    def _with(self, groups: list[list[ExactGPBase]], idcs: list[int]) -> Self:
        """The same mixtures, of some outputs, of other models."""
        other = type(self).__new__(type(self))
        Model.__init__(other)
        other.num_samples, other.input_names = self.num_samples, self.input_names
        other._made_of = None
        other.output_names = tuple(self.output_names[i] for i in idcs)
        other.weights = {name: [w[i] for i in idcs] for name, w in self.weights.items()}
        other.groups = ModuleList([ModuleList(group) for group in groups])
        other._labels = [self._labels[i] for i in idcs]
        other._orders = [self._orders[i] for i in idcs]
        return other.eval()


def allocation(weights: Tensor, total: int) -> list[int]:
    """Whole numbers in proportion to weights, ``total`` in all, by the largest remainders."""
    exact = weights * total / weights.sum()
    counts = exact.floor().long()
    rest = (exact - counts).argsort(descending=True, stable=True)[: total - int(counts.sum())]
    counts[rest] += 1
    return counts.tolist()


def _orders(num_outputs: int, number: int) -> Tensor:
    """An order of components for each output, ``m x S``, in which pairs fill a square evenly."""
    return SobolEngine(num_outputs).draw(number).argsort(0).argsort(0).mT


def _part(model: ExactGPBase, output: int, count: int) -> ExactGPBase:
    """A model of one output, with as many of its samples, evenly spread, as it has components."""
    part = model.subset_output([output]) if model.num_outputs > 1 else model
    if part.num_samples is None:
        return deepcopy(part)
    index = torch.linspace(0, part.num_samples - 1, count).round().long()
    return take_samples(part, index, as_mixture=True)


def _for_each(moments: Tensor, count: int, dim: int) -> Tensor:
    """Moments of ``count`` components, where a model without samples has one for all of them."""
    shape = [*moments.shape]
    shape[dim] = count
    return moments.expand(shape)


def _joint(part: Part, posterior: Any) -> tuple[Tensor, Tensor]:
    """Means ``... x S x q`` and covariances ``... x S x q x q`` of a part's components."""
    mean: Tensor = posterior.distribution.mean
    covariance: Tensor = to_dense(posterior.distribution.lazy_covariance_matrix)
    if part.model.num_samples is None:
        mean, covariance = mean.unsqueeze(-2), covariance.unsqueeze(-3)
    return _for_each(mean, part.number, -2), _for_each(covariance, part.number, -3)


def _fantasy(part: Part, X: Tensor, Y: Tensor) -> ExactGPBase:
    """A part conditioned on observations ``f x batch x S x k x 1``, for each of its components."""
    model = part.model
    if model.num_samples is None:  # as many samples of one point
        model = deepcopy(model)
        model.hold_samples(
            {n: p.expand(part.number, *p.shape) for n, p in model.named_parameters()}
        )
    known = isinstance(model.likelihood, FixedNoiseGaussianLikelihood)
    noise = model.observation_noise(X).unsqueeze(-1).expand(Y.shape[1:]) if known else None
    return model.with_observations(X, Y, noise)


def _of_output(observation_noise: bool | Tensor, output: int) -> bool | Tensor:
    if isinstance(observation_noise, Tensor) and observation_noise.shape[-1] > 1:
        return observation_noise[..., output : output + 1]
    return observation_noise


def _as_weights(weights: Tensor | Sequence[Sequence[float]]) -> Tensor:
    try:
        return torch.as_tensor(weights, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(
            "Expected weights as a tensor or lists of numbers, a row for each model with one for "
            f"each output, got {weights!r}."
        ) from error


def _check(models: Mapping[str, ExactGPBase], weights: Tensor) -> ExactGPBase:
    """Raise what the constructor raises; return the first model."""
    if not models:
        raise ValueError("Expected models to stack, got none.")
    for name, model in models.items():
        if not isinstance(model, ExactGPBase):
            raise TypeError(
                "Expected exact models of gpadjust, such as CKA, got a "
                f"{type(model).__name__} as {name!r}."
            )
    first, *others = models.values()
    for other in others:
        if not _same_data(first, other):
            raise ValueError(
                f"Expected models of the same data, got {first!r} and {other!r} of different ones; "
                "stack models of the same points and outputs."
            )
    if weights.shape != (len(models), first.num_outputs):
        raise ValueError(
            f"Expected weights of shape {(len(models), first.num_outputs)}, one for each model and "
            f"output, got {tuple(weights.shape)}."
        )
    if not (weights >= 0).all() or not torch.allclose(weights.sum(0), weights.new_ones(())):
        raise ValueError(
            f"Expected weights that are not negative and 1 in all for each output, got {weights}."
        )
    return first


@torch.no_grad()
def _same_data(one: ExactGPBase, other: ExactGPBase) -> bool:
    """Whether two models are of the same names, inputs and targets, but for rounding."""
    if (one.input_names, one.output_names) != (other.input_names, other.output_names):
        return False
    ours, theirs = one.data(), other.data()
    return all(_close(ours[name], theirs[name]) for name in ("train_X", "train_Y"))


def _close(one: Tensor | None, other: Tensor | None) -> bool:
    if one is None or other is None or one.shape != other.shape:
        return False
    atol = 1e-9 * float(one.nan_to_num().abs().max())
    return torch.allclose(one, other, rtol=0, atol=atol, equal_nan=True)
