"""A mixture of models of several structures, as a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy, deepcopy
from typing import Any, Self

import torch
from botorch.models.utils import fantasize as fantasize_flag
from botorch.posteriors.fully_bayesian import MCMC_DIM
from botorch.sampling import MCSampler
from torch import Size, Tensor
from torch.nn import Module, ModuleList
from torch.quasirandom import SobolEngine

from gpadjust.checks import checked_whole
from gpadjust.models.hyperparameter_samples import take_samples
from gpadjust.models.predictive_model import PredictiveModel, given_noise
from gpadjust.models.sampled_functions import check_each
from gpadjust.models.terms_gp import TermsGP
from gpadjust.models.training_data import ArrayLike, check_noise, new_observations


class Part(Module):
    """The ``number`` components of an output's mixture that are of one structure.

    The model is of that output alone; one without samples is all of them.
    """

    def __init__(self, name: str, model: TermsGP, number: int) -> None:
        super().__init__()
        self.name, self.model, self.number = name, model, number

    def joint(self, X: ArrayLike, observation_noise: bool) -> tuple[Tensor, Tensor]:
        """Means ``... x S x q`` and covariances ``... x S x q x q``."""
        mean, covariance = self.model.joint_moments(X, observation_noise)
        if self.model.num_samples is None:
            mean, covariance = mean.unsqueeze(-2), covariance.unsqueeze(-3)
        return self._repeated(mean, -2), self._repeated(covariance, -3)

    def marginals(self, X: ArrayLike, observation_noise: bool) -> tuple[Tensor, Tensor]:
        """Means and variances, ``... x S x q x 1``."""
        mean, variance = self.model.components(X, observation_noise)
        return self._repeated(mean, MCMC_DIM), self._repeated(variance, MCMC_DIM)

    def _repeated(self, moments: Tensor, dim: int) -> Tensor:
        shape = [*moments.shape]
        shape[dim] = self.number
        return moments.expand(shape)


class StackedGP(PredictiveModel):
    r"""Predictive distributions of several models, stacked: their weighted mixture.

    .. math:: p(f(x)) = \sum_k w_k \, p_k(f(x))

    (Yao et al. 2018), with weights for each output, which :func:`~gpadjust.compare` finds. The
    mixture is of equally likely Gaussians: samples of each model's hyper-parameters, in proportion
    to its weight. To BoTorch it is a fully Bayesian model, so that acquisition functions average
    over the components. As outputs are independent, components of each structure of one meet those
    of all structures of another. It has no outcome transform, so that variances given to
    :meth:`posterior` as ``observation_noise`` are in the square of the user's units, too.

    Args:
        models: Fitted models of the same data, by the names of their structures.
        weights: The weight of each model for each output, ``K x m``; in all 1 for each output.
        num_components: Number ``S`` of Gaussians; weights are rounded to multiples of ``1 / S``.
            The time of predictions grows with it, and that of some acquisition functions much
            more: the noisy hypervolume improvement of two outputs took 64 s with 32.

    Attributes:
        parts: The parts of the mixture of each output, lists of :class:`Part`.
        num_samples: ``S``.

    Raises:
        TypeError: If models do not come by name, one is none of this library, or weights are no
            numbers.
        ValueError: If there is no model, their data or links differ, or weights are of another
            shape, negative, or not 1 in all.

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
    num_samples: int

    def __init__(
        self,
        models: Mapping[str, TermsGP],
        weights: Tensor | Sequence[Sequence[float]],
        num_components: int = 32,
    ) -> None:
        super().__init__()
        checked_whole("num_components", num_components, 1)
        first, shares = _checked(models, weights)
        parts = []
        for j, share in enumerate(shares.unbind(-1)):
            counts = zip(models.items(), allocation(share, num_components), strict=True)
            parts.append([Part(name, _components(m, j, n), n) for (name, m), n in counts if n])
        self.parts: Any = ModuleList(map(ModuleList, parts))
        self.num_samples = num_components
        self.input_names, self.output_names = first.input_names, first.output_names
        self.levels, self.batches = first.levels, first.batches
        self._structures = [*models]
        self._made_of: dict[str, TermsGP] | None = {**models}
        # An order of components for each output, in which pairs of outputs fill a square evenly.
        orders = SobolEngine(len(parts)).draw(num_components).argsort(0).argsort(0).unbind(-1)
        alone = torch.arange(num_components)
        self._orders = [o if len(p) > 1 else alone for o, p in zip(orders, parts, strict=True)]
        self.eval()

    @property
    def weights(self) -> dict[str, list[float]]:
        """The weights of each structure, one for each output, after rounding, by its name."""
        numbers = [{part.name: part.number for part in parts} for parts in self.parts]
        return {
            name: [number.get(name, 0) / self.num_samples for number in numbers]
            for name in self._structures
        }

    @property
    def made_of(self) -> dict[str, TermsGP]:
        """The models by name; a ValueError if it is a subset of outputs, or was conditioned."""
        if self._made_of is None:
            raise ValueError(
                "This mixture is of parts of models, a subset of their outputs or conditioned; "
                "take the StackedGP that it was made from."
            )
        return {**self._made_of}

    @property
    def num_outputs(self) -> int:
        """The number ``m`` of outputs."""
        return len(self.parts)

    @property
    def batch_shape(self) -> Size:
        """One dimension, of the components."""
        return Size([self.num_samples])

    def train(self, mode: bool = True) -> Self:
        """Put the model in eval mode; a RuntimeError for train mode, as it is not trained."""
        if mode:
            raise RuntimeError(
                "A StackedGP is made of fitted models, and not trained: `gpadjust.fit` its models "
                "and stack them again."
            )
        return super().train(mode)

    def __repr__(self) -> str:
        return f"StackedGP of {', '.join(self._structures)}: {self.num_samples} components"

    def summary(self) -> str:
        """The weights of each output, and what each of the models has learnt."""
        lines = [
            f"{p.number / self.num_samples:.0%} of {name}: {p.name}, {p.model.summary()}"
            for name, parts in zip(self.output_names, self.parts, strict=True)
            for p in parts
        ]
        return "\n".join([repr(self), *lines])

    @property
    def link(self) -> Any:
        """The link of the models, which is the same for all, or None."""
        return self.parts[0][0].model.link

    def _check_no_link(self) -> None:
        if self.link is not None:
            raise ValueError(
                "Expected observation_noise True or False for a mixture of models with a link, "
                "got variances; pass these to one of the models, `stacked.made_of`."
            )

    def components(self, X: ArrayLike, observation_noise: bool | Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances of all components, ``... x S x q x m``."""
        outputs = []
        for parts in self.parts:
            each = zip(
                *(part.marginals(X, observation_noise is True) for part in parts), strict=True
            )
            outputs.append([torch.cat(moments, MCMC_DIM) for moments in each])
        mean, variance = (torch.cat(moments, -1) for moments in zip(*outputs, strict=True))
        if not isinstance(observation_noise, bool):
            self._check_no_link()
            noise = given_noise(observation_noise, mean.shape[-2], self.num_outputs)
            variance = variance + noise.unsqueeze(MCMC_DIM)
        return mean, variance

    def joint_moments(
        self, X: ArrayLike, observation_noise: bool | Tensor
    ) -> tuple[Tensor, Tensor]:
        """Means ``... x S x (m) x q`` and covariances ``... x S x (m) x q x q``."""
        outputs = []
        for parts, order in zip(self.parts, self._orders, strict=True):
            each = zip(*(part.joint(X, observation_noise is True) for part in parts), strict=True)
            mean, covariance = (torch.cat(m, dim) for m, dim in zip(each, (-2, -3), strict=True))
            outputs.append((mean[..., order, :], covariance[..., order, :, :]))
        moments = zip(zip(*outputs, strict=True), (-2, -3), strict=True)
        mean, covariance = (torch.stack(each, dim) for each, dim in moments)
        if not isinstance(observation_noise, bool):
            self._check_no_link()
            noise = given_noise(observation_noise, mean.shape[-1], self.num_outputs)
            noise = noise.mT.unsqueeze(MCMC_DIM).expand(mean.shape)
            covariance = covariance + torch.diag_embed(noise)
        return (
            (mean, covariance) if len(outputs) > 1 else (mean.squeeze(-2), covariance.squeeze(-3))
        )

    def draw_functions(self, num_functions: int, num_features: int) -> StackedFunctions:
        """The functions of :meth:`sample_functions`, spread over the components."""
        functions, owners = [], []
        for parts in self.parts:
            numbers = torch.tensor([part.number for part in parts])
            owner = torch.arange(len(parts)).repeat_interleave(numbers)
            owner = owner[torch.randperm(self.num_samples)]
            owner = owner[torch.arange(num_functions) % self.num_samples]
            counts = zip(parts, owner.bincount(minlength=len(parts)).tolist(), strict=True)
            functions.append([p.model.draw_functions(n, num_features) for p, n in counts if n])
            owners.append(owner)
        return StackedFunctions(functions, torch.stack(owners))

    def subset_output(self, idcs: list[int]) -> Self:
        """The mixtures of some outputs; negative numbers count from the end."""
        idcs = self.checked_outputs(idcs)
        return self._with([[*self.parts[i]] for i in idcs], idcs)

    def condition_on_observations(
        self, X: ArrayLike, Y: ArrayLike, noise: Tensor | None = None
    ) -> Self:
        """Condition each part on new observations; the weights stay.

        Args:
            X: Raw inputs, ``k x d``.
            Y: Observations, ``k x m``, in the user's units; NaN where an output was not observed.
            noise: The variances of the new observations, of the shape of ``Y``, if they are known.

        The errors are those of :meth:`CKA.condition_on_observations`.
        """
        names, m = self.input_names, self.num_outputs
        X, Y = new_observations(X, Y, names, m, self.levels, self.batches)
        if X.dim() + Y.dim() > 4:
            raise ValueError(
                f"Expected X of shape k x d and Y of shape k x {self.num_outputs}, got "
                f"{tuple(X.shape)} and {tuple(Y.shape)}; fantasies are made of its parts."
            )
        if noise is not None:
            check_noise(noise, Y)

        def conditioned(part: Part, j: int) -> Part:
            # An output that was not observed has the row, too, so that all have the same ones.
            own = None if noise is None else noise[:, [j]]
            return Part(part.name, part.model.with_observations(X, Y[:, [j]], own), part.number)

        parts = [[conditioned(part, j) for part in parts] for j, parts in enumerate(self.parts)]
        return self._with(parts, [*range(self.num_outputs)])

    def fantasize(self, X: Tensor, sampler: MCSampler) -> Self:
        """Condition each component on observations that are drawn from it; see BoTorch.

        Args:
            X: Raw inputs, ``batch_shape x k x d``.
            sampler: Draws the observations from the posterior at ``X``.

        Raises:
            ValueError: If a part cannot hold samples, as one of a batch of data sets.
        """
        with fantasize_flag():
            Y = sampler(self.posterior(X, observation_noise=True))  # f x batch x S x k x m
            fantasies = []
            for j, (parts, order) in enumerate(zip(self.parts, self._orders, strict=True)):
                numbers = [part.number for part in parts]
                own = Y[..., order.argsort(), :, j].unsqueeze(-1).split(numbers, dim=-3)
                fantasies.append([_fantasy(p, X, y) for p, y in zip(parts, own, strict=True)])
        return self._with(fantasies, [*range(self.num_outputs)])

    def _with(self, parts: list[list[Part]], idcs: list[int]) -> Self:
        """The mixtures of some outputs, of other parts."""
        other = copy(self)
        other._modules = {}  # not this one's, which a shallow copy shares
        other.parts = ModuleList(map(ModuleList, parts))
        other.output_names = tuple(self.output_names[i] for i in idcs)
        other._orders = [self._orders[i] for i in idcs]
        other._made_of = None
        return other.eval()


class StackedFunctions(Module):
    """Functions drawn from a mixture, of several models for each output.

    The owners, ``m x k``, say which of these models each function is of.
    """

    owners: Tensor

    def __init__(self, functions: list[list[Module]], owners: Tensor) -> None:
        super().__init__()
        owners = torch.stack([each.unique(return_inverse=True)[1] for each in owners])
        self.functions: Any = ModuleList(map(ModuleList, functions))
        self.register_buffer("owners", owners)

    def forward(self, X: Tensor) -> Tensor:
        """Evaluate the functions at raw ``X`` (``... x q x d``): ``k x ... x q x m``."""
        return self._side_by_side(lambda functions, own: functions(X))

    def each(self, X: Tensor) -> Tensor:
        """Evaluate each function at points of its own, ``k x q x d``: ``k x q x m``."""
        check_each(X, self.owners.shape[-1])
        return self._side_by_side(lambda functions, own: functions.each(X[own]))

    def _side_by_side(self, evaluate: Callable[[Any, Tensor], Tensor]) -> Tensor:
        outputs = []
        for models, owner in zip(self.functions, self.owners, strict=True):
            values = torch.cat([evaluate(f, owner == i) for i, f in enumerate(models)])
            outputs.append(values[owner.argsort(stable=True).argsort()])
        return torch.cat(outputs, -1)


def allocation(weights: Tensor, total: int) -> list[int]:
    """Whole numbers in proportion to weights, ``total`` in all, by the largest remainders."""
    exact = weights * total / weights.sum()
    counts = exact.floor().long()
    rest = (exact - counts).argsort(descending=True, stable=True)[: total - int(counts.sum())]
    counts[rest] += 1
    return counts.tolist()


def _components(model: TermsGP, output: int, count: int) -> TermsGP:
    """A model of one output, with as many of its samples, evenly spread, as it has components."""
    part = model.subset_output([output]) if model.num_outputs > 1 else model
    if part.num_samples is None:
        return deepcopy(part)
    index = torch.linspace(0, part.num_samples - 1, count).round().long()
    return take_samples(part, index, as_mixture=True)


def _fantasy(part: Part, X: Tensor, Y: Tensor) -> Part:
    """A part conditioned on observations ``f x batch x S x k x 1``, for each of its components."""
    model = part.model
    if model.num_samples is None:  # as many samples of one point
        model = deepcopy(model)
        model.hold_samples(
            {n: p.expand(part.number, *p.shape) for n, p in model.named_parameters()}
        )
    noise = None
    if model.noise.is_known:
        noise = model.observation_noise(X).unsqueeze(-1).expand(Y.shape[1:])
    return Part(part.name, model.with_observations(X, Y, noise), part.number)


def _checked(models: Any, weights: Any) -> tuple[TermsGP, Tensor]:
    """The first of the models, and the weights as a tensor; or what the constructor raises."""
    if not isinstance(models, Mapping):
        found = type(models).__name__
        raise TypeError(f"Expected models by name, {{'CKA': model, ...}}, got a {found} of them.")
    for name, model in models.items():
        if not isinstance(model, TermsGP):
            found = type(model).__name__
            raise TypeError(f"Expected exact models such as CKA, got a {found} as {name!r}.")
    if not models:
        raise ValueError("Expected models to stack, got none.")
    try:
        weights = torch.as_tensor(weights, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(
            "Expected weights as a tensor or lists of numbers, a row for each model with one for "
            f"each output, got {weights!r}."
        ) from error
    first, *others = models.values()
    for other in others:
        check_stackable(first, other)
    if weights.shape != (len(models), first.num_outputs):
        raise ValueError(
            f"Expected weights of shape {(len(models), first.num_outputs)}, one for each model and "
            f"output, got {tuple(weights.shape)}."
        )
    if not (weights >= 0).all() or not torch.allclose(weights.sum(0), weights.new_ones(())):
        raise ValueError(
            f"Expected weights that are not negative and 1 in all for each output, got {weights}."
        )
    return first, weights


def check_stackable(first: TermsGP, other: TermsGP) -> None:
    """Raise a ValueError if two models have other data or another link."""
    if not _same_data(first, other):
        raise ValueError(
            f"Expected models of the same points and outputs, but the data of {first!r} and "
            f"{other!r} differ."
        )
    if getattr(first.link, "bounds", None) != getattr(other.link, "bounds", None):
        bounds = [getattr(model.link, "bounds", "none") for model in (first, other)]
        raise ValueError(
            f"Expected models of one link, but the bounds of outcome_transform are {bounds[0]} of "
            f"one and {bounds[1]} of another: give all structures the same."
        )


@torch.no_grad()
def _same_data(one: TermsGP, other: TermsGP) -> bool:
    """Return whether two models have the same names, inputs and targets, but for rounding."""
    if (one.input_names, one.output_names) != (other.input_names, other.output_names):
        return False
    ours, theirs = one.data(), other.data()
    pairs: list[Any] = [(ours[name], theirs[name]) for name in ("train_X", "train_Y")]
    return all(
        a.shape == b.shape
        and torch.allclose(a, b, 0.0, 1e-9 * float(a.nan_to_num().abs().max()), equal_nan=True)
        for a, b in pairs
    )
