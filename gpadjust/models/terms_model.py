"""Predictions of a model that is a sum of terms, by any conditioning on data."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from inspect import signature
from typing import Any, ClassVar, NamedTuple, Self

import torch
from botorch.models.transforms.outcome import OutcomeTransform
from botorch.posteriors import Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM
from botorch.utils.datasets import SupervisedDataset
from gpytorch.settings import detach_test_caches
from torch import Tensor
from torch.nn import Module
from torch.nn.functional import pad

from gpadjust.checks import check_level, checked_whole
from gpadjust.gp import AppendedPhysics, PhysicsInput, SumOfTerms, Term, WeightedSum
from gpadjust.gp.noise import Noise
from gpadjust.gp.term import Unit
from gpadjust.models.hyperparameter_samples import take_samples
from gpadjust.models.levels import coded
from gpadjust.models.links import plain
from gpadjust.models.local_errors import LocalErrors
from gpadjust.models.physics_parameters import PhysicsParameters
from gpadjust.models.posteriors import mixture_moments, mixture_quantile
from gpadjust.models.predictive_model import PredictiveModel, given_noise
from gpadjust.models.sampled_functions import FunctionPerBatch, SampledFunctions
from gpadjust.models.summary import summary, title
from gpadjust.models.term_builder import ModelOptions
from gpadjust.models.training_data import (
    ArrayLike,
    TrainingData,
    as_given,
    check_order,
    to_tensor,
)
from gpadjust.physics import Physics


class Adjustment(NamedTuple):
    """A rho or a delta at some points, as :meth:`TermsModel.adjustments` returns it.

    Args:
        mean: Posterior means, ``q x m``; of a rho without units, else in the targets'.
        lower: Lower ends of the intervals.
        upper: Upper ends.
    """

    mean: Any
    lower: Any
    upper: Any


_SHARED = "Unpack[ModelOptions]"  # how a constructor says that it takes these and no others


class TermsModel(PredictiveModel):
    r"""A model of a sum of terms, :math:`f(x) = \sum_t b_t(x) g_t(x)`, and of each of them.

    The base of exact models and of sparse ones, beside BoTorch's own of each. In an adjusted
    physics :math:`f_a(x) = \sum_i \rho_i(x) f_i(x) + \delta(x)` the terms that scale a physics are
    the rhos; with a center c, :math:`f_p - c` is what they scale, and :math:`\delta = \delta_0 -
    \sum_i c_i \rho_i` for the model's own term :math:`\delta_0`.

    Attributes:
        covar_module: The covariance of the sum, which holds the terms.
        num_samples: The number of samples of the hyper-parameters that :func:`~gpadjust.fit` drew,
            or None.
        train_targets: Targets in the model's units, ``batch_shape x (m) x n``; NaN where one is
            missing.
        data_arguments: The names of the constructor's arguments that hold data, or are made of
            them; :meth:`data` has them.
        options: The other arguments that the model was built with, as far as a file can hold them.
        objects: The names of those that it cannot hold.
        not_sampled: Why hyper-parameters of the class cannot be sampled; empty if they can.
    """

    not_sampled: ClassVar[str] = ""
    data_arguments: ClassVar[tuple[str, ...]] = ("train_X", "train_Y", "train_Yvar", "train_Xvar")
    covar_module: SumOfTerms
    input_transform: Any
    likelihood: Any
    train_inputs: Any
    train_targets: Tensor
    options: dict[str, Any]
    objects: list[str]
    _num_outputs: int
    _aug_batch_shape: Any

    def __new__(cls, *args: Any, **options: Any) -> Self:
        """Remember the options that the model is built with, for :func:`gpadjust.save`."""
        model = super().__new__(cls)
        own = signature(cls.__init__).parameters
        names = [*own][1:]
        if any(each.annotation == _SHARED for each in own.values()):
            known = {n for n in names if own[n].annotation != _SHARED}
            known |= {*ModelOptions.__annotations__}
            if unknown := [name for name in options if name not in known]:
                raise TypeError(
                    f"{cls.__name__}() got an unexpected keyword argument {unknown[0]!r}; it takes "
                    f"{', '.join(sorted(known))}."
                )
        every = {**dict(zip(names, args, strict=False)), **options}
        if callable(variances := every.get("train_Yvar")) and not isinstance(variances, Tensor):
            raise TypeError("Got a function as train_Yvar: did you mean physics=...?")
        every = {n: v for n, v in every.items() if n not in (*cls.data_arguments, "physics")}
        if isinstance(outcomes := every.get("outcome_transform"), OutcomeTransform):
            every["outcome_transform"] = plain(outcomes)
        # Others than plain values are told by name alone, or they would have to pickle.
        model.options = {n: v for n, v in every.items() if _is_plain(v)}
        model.objects = [n for n, v in every.items() if not _is_plain(v)]
        return model

    def remember_levels(self, data: TrainingData) -> None:
        """Remember the levels of categories, for a file, too."""
        self.levels, self.batches = data.levels, tuple(data.batches)
        self.options |= {"categorical": data.levels, "batch": list(data.batches)}
        self.objects = [name for name in self.objects if name != "categorical"]

    def __repr__(self) -> str:
        return title(self)

    def conditioning(self) -> Any:
        """Return the posterior of the terms; it is built if there is none.

        It has ``marginals`` and ``joint``: moments of a :class:`~gpadjust.gp.WeightedSum`.
        """
        raise NotImplementedError

    def data(self) -> dict[str, Tensor | None]:
        """Return the data of the model: raw inputs, targets and known variances."""
        raise NotImplementedError

    def log_evidence(self) -> tuple[str, Tensor | None]:
        """Return the name and the value, ``... x (m)``, of the measure of fit."""
        raise NotImplementedError

    def summary(self) -> str:
        """Return the hyper-parameters, parameters and scores as a text in the user's units.

        The structure; unknown parameters of the physics; of each output the root mean square error
        of the physics alone at the observations; the log marginal likelihood; means, standard
        deviations and lengthscales of the terms; the noise as a standard deviation; and what is at
        a bound. Of a model that holds samples, their medians and the ranges of 95 % of them.
        """
        return summary(self)

    @property
    def noise(self) -> Noise:
        """The noise of observations."""
        return Noise(self.likelihood)

    @property
    def has_heavy_tails(self) -> bool:
        """True if observations may be outliers."""
        rows = self.noise.rows
        return rows is not None and any(source.has_outliers for source in rows.sources)

    @property
    def terms(self) -> Sequence[Term]:
        """The terms of the sum."""
        terms: Sequence[Term] = self.covar_module.terms
        return terms

    @property
    def term_names(self) -> tuple[str, ...]:
        """The names of the terms that are unknown, for :meth:`term`."""
        return tuple(term.name for term in self.terms if not term.is_known)

    @property
    def rho_names(self) -> tuple[str, ...]:
        """The names of the terms that scale a physics, one for each physics."""
        return tuple(t.name for t in self.terms if t.unit is Unit.NONE)

    @property
    def other_names(self) -> tuple[str, ...]:
        """The names of the other terms: delta, and those of a structure of your own."""
        return tuple(t.name for t in self.terms if t.unit is not Unit.NONE)

    @property
    def has_center(self) -> bool:
        """True if a center is taken from f_p: delta then depends on rho a priori."""
        return bool(self._centerd())

    @property
    def physics(self) -> Physics:
        """The physics f_p; of several, all of them side by side."""
        physics: Physics = self.input_transform.physics
        return physics

    @property
    def has_unknowns(self) -> bool:
        """True if the physics has unknown parameters."""
        transform = getattr(self, "input_transform", None)
        return isinstance(transform, PhysicsInput) and bool(transform.physics.unknowns)

    @property
    def physics_parameters(self) -> PhysicsParameters:
        """The posterior of the physics' unknown parameters; an error if there are none."""
        return PhysicsParameters.of(self.input_transform if self.has_unknowns else None)

    def rho(self, X: ArrayLike, physics: str | int | None = None, mixed: bool = True) -> Posterior:
        r"""The posterior of the scaling :math:`\rho` at ``X``, ``q x m``; f_p is not evaluated.

        Rho and delta apart are far less certain than their sum, which alone is observed.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            physics: Which of several physics, by its name or number.
            mixed: As in :meth:`term`.

        Raises:
            ValueError: If the model has no such rho.
        """
        return self.term(self.rho_name(physics), X, mixed)

    def delta(self, X: ArrayLike, mixed: bool = True) -> Posterior:
        r"""The posterior of the bias :math:`\delta`, in the targets' units; as :meth:`rho`."""
        return self.term("delta", X, mixed)

    def term(self, name: str, X: ArrayLike, mixed: bool = True) -> Posterior:
        """The posterior of a term's Gaussian process, ``q x m``; its basis is not evaluated.

        A rho is without units, others are in the targets'. No graph unless ``X`` asks for one.

        Args:
            name: One of ``term_names``.
            X: Raw inputs, ``batch_shape x q x d``.
            mixed: Of a model that holds ``S`` samples of its hyper-parameters: whether moments and
                draws are those of the mixture, ``... x q x m``; else they are those of each sample,
                ``... x S x q x m``, as :meth:`posterior` has them for BoTorch.

        Raises:
            ValueError: If there is no such term.
        """
        unknown = [term for term in self.terms if term.name == name and not term.is_known]
        if not unknown:
            raise ValueError(
                f"{type(self).__name__} has no unknown term {name!r}; it has "
                f"{', '.join(map(repr, self.term_names))}."
            )
        (term,) = unknown
        with self._graph_for(X):
            inputs = self.model_inputs(X, with_basis=False)
            mean, covariance = self.conditioning().joint(self._at(term, inputs))
            shift, scale = self.units(term.unit)
            covariance = covariance * scale.square().unsqueeze(-1)
            return self.as_posterior(mean * scale + shift, covariance, mixed)

    def adjustments(self, X: ArrayLike, level: float = 0.95) -> Any:
        r"""Every :math:`\rho` and :math:`\delta` with its interval, at each point by itself.

        The moments of :meth:`term`, without the covariances between points, so that there may be
        many of them.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            level: The probability that an interval holds.

        Returns:
            Of tensors and arrays, an :class:`Adjustment` for each of ``term_names``, by name: mean,
            lower and upper, ``q x m``. Of a frame, one frame with columns such as ``rho mean``,
            ``rho lower``, ``rho upper`` and ``delta mean``, of several outputs ``rho of head
            mean``, and the index of X.

        Raises:
            ValueError: If ``level`` is not between 0 and 1.

        Example:
            >>> import torch
            >>> from gpadjust import CKA
            >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
            >>> model = CKA(X, X.sin(), physics=lambda X: X)
            >>> rho, delta = model.adjustments(X).values()
            >>> bool((rho.lower < rho.mean).all()), delta.upper.shape
            (True, torch.Size([8, 1]))
        """
        check_level(level)
        found: dict[str, Adjustment] = {}
        with self._graph_for(X):
            inputs = self.model_inputs(X, with_basis=False)
            for term in (term for term in self.terms if term.name in self.term_names):
                shift, scale = self.units(term.unit)
                mean, variance = self.conditioning().marginals(self._at(term, inputs))
                moments = torch.broadcast_tensors(mean * scale + shift, variance * scale.square())
                mean, variance = (self.outputs_last(each) for each in moments)
                if self.num_samples is None:
                    mean, variance = mean.unsqueeze(MCMC_DIM), variance.unsqueeze(MCMC_DIM)
                ends = [mixture_quantile(mean, variance, (1 + s * level) / 2) for s in (-1, 1)]
                found[term.name] = Adjustment(mixture_moments(mean, variance)[0], *ends)
        if not hasattr(X, "columns"):
            return {n: Adjustment(*(as_given(v, X, ()) for v in a)) for n, a in found.items()}
        of = [f" of {name}" if self.num_outputs > 1 else "" for name in self.output_names]
        names = [f"{n}{each} {k}" for n in found for k in Adjustment._fields for each in of]
        return as_given(torch.cat([v for a in found.values() for v in a], -1), X, names)

    def rho_name(self, physics: str | int | None = None) -> str:
        """The name of the term that scales a physics, which is given by name or number."""
        names = self.rho_names
        if not names:
            raise ValueError(f"{type(self).__name__} has no rho, as it has no physics.")
        short = [name.removeprefix("rho_") for name in names]
        if physics is None and len(names) == 1:
            return names[0]
        if isinstance(physics, int) and -len(names) <= physics < len(names):
            return names[physics]
        if physics in (*names, *short):
            return names[(*names, *short).index(physics) % len(names)]
        raise ValueError(
            f"Expected physics to be one of {', '.join(short)}, or a number from 0 to "
            f"{len(names) - 1}, got {physics!r}."
        )

    def term_mean(self, name: str, output: int = 0) -> float:
        """The prior mean of a term, to which it falls back far from the data.

        Of a model that holds samples of its hyper-parameters it is their mean; of a batch, that of
        the first.
        """
        (term,) = (t for t in self.terms if t.name == name)
        shift, scale = self.units(term.unit)
        mean = self._at(term, self.train_inputs[0][..., :1, :]).mean() * scale + shift
        mean = mean.reshape(-1, self.num_outputs)[:, output]
        return float(mean[0] if self.num_samples is None else mean.mean())

    def fallback(self, X: ArrayLike) -> Tensor:
        """Return the prediction far from all data: the prior mean, such as f_p itself.

        Weights of the physics that are unknown (``rho_mean="learn"``) are those it began with, 1,
        or least squares of several; after a point fit they are its estimates. Samples that do
        without the physics (see :func:`~gpadjust.fit`) count as if they had it.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.

        Returns:
            ``batch_shape x q x m``, in the units of the targets.
        """
        inputs = self.model_inputs(X)
        shift, scale = self.units()
        means = {t.name: t.mean if t.learns_mean else t.given_mean for t in self.terms}
        # The same for all samples of hyper-parameters but for rounding.
        values = self.outputs_last(self.at(inputs).combine(means) * scale + shift)
        values = values if self.link is None else self.link.inverse(values)
        return values if self.num_samples is None else values.mean(MCMC_DIM)

    def components(self, X: ArrayLike, observation_noise: bool | Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances for each sample of the hyper-parameters, ``... x S x q x m``."""
        with self._graph_for(X):
            inputs = self.model_inputs(X)
            mean, variance = self.conditioning().marginals(self.at(inputs))
            shift, scale = self.units()
            mean, variance = mean * scale + shift, variance * scale.square()
            noise = self._noise(inputs, observation_noise)
            wider = self.widening(inputs)
            if wider is not None:
                variance = variance * wider
            if noise is not None:  # given variances are in the user's units
                unit = scale.square() if observation_noise is True else 1.0
                if self.link is not None and observation_noise is not True:
                    unit = (2 * self.link.log_slope(self.link.inverse(mean))).exp()
                variance = variance + noise * unit
            # Fantasies share their variances.
            mean, variance = (
                self.outputs_last(each) for each in torch.broadcast_tensors(mean, variance)
            )
        if self.num_samples is None:
            mean, variance = mean.unsqueeze(MCMC_DIM), variance.unsqueeze(MCMC_DIM)
        return mean, variance

    def joint_moments(
        self, X: ArrayLike, observation_noise: bool | Tensor
    ) -> tuple[Tensor, Tensor]:
        """Means ``... x (S) x (m) x q`` and covariances ``... x (S) x (m) x q x q``."""
        inputs = self.model_inputs(X)
        mean, covariance = self.conditioning().joint(self.at(inputs))
        noise = self._noise(inputs, observation_noise)
        wider = self.widening(inputs)
        if wider is not None:
            root = wider.sqrt()
            covariance = covariance * root.unsqueeze(-1) * root.unsqueeze(-2)
        if noise is not None:
            covariance = covariance + torch.diag_embed(noise.expand(mean.shape))
        shift, scale = self.units()
        return mean * scale + shift, covariance * scale.square().unsqueeze(-1)

    @property
    def larger_errors(self) -> LocalErrors | None:
        """The places of errors larger than the kernels', if there are any."""
        return None

    def widening(self, inputs: Tensor) -> Tensor | None:
        """Return the factor of variances at transformed inputs, ``... x (m) x q``; None for 1."""
        errors = self.larger_errors
        if errors is None:
            return None
        x = inputs[..., : self.terms[0].num_inputs]
        if self.num_samples is not None:  # which differ in the parameters of the physics alone
            x = x.narrow(MCMC_DIM - (self._num_outputs > 1), 0, 1)
        wider: Tensor = errors(x)
        return wider

    def draw_functions(self, num_functions: int, num_features: int) -> Module:
        """The functions of :meth:`sample_functions`, spread over samples of hyper-parameters."""
        if self.num_samples is None:
            return self._functions_of_batches(num_functions, num_features)
        order = torch.randperm(self.num_samples)
        each = take_samples(self, order[torch.arange(num_functions) % self.num_samples])
        return FunctionPerBatch(each._functions_of_batches(1, num_features))

    def mean_functions(self, most: int | None = None) -> Module:
        """The posterior mean, as a function to be called anywhere: faster than ``predict``.

        Args:
            most: The most samples of the hyper-parameters to take, evenly of those held, at least
                1. Default: all.

        Returns:
            As of :meth:`sample_functions`: a mean for each sample of the hyper-parameters, or a
            single one.
        """
        if most is not None:
            checked_whole("most", most, 1)
        self.eval()
        if self.num_samples is None:
            return self._functions_of_batches(None)
        taken = self.num_samples if most is None else min(most, self.num_samples)
        each = take_samples(self, torch.arange(taken) * self.num_samples // taken)
        return FunctionPerBatch(each._functions_of_batches(None))

    def _functions_of_batches(self, number: int | None, num_features: int = 0) -> SampledFunctions:
        """So many functions of each batch of the model, or its mean."""
        if number is None:
            return SampledFunctions.mean(self)
        return SampledFunctions.by_matheron(self, number, num_features)

    def at(self, inputs: Tensor) -> WeightedSum:
        """The function itself at transformed inputs, ``... x n x (d + k)``."""
        return self.covar_module.at(inputs)

    def model_inputs(self, X: ArrayLike, with_basis: bool = True) -> Tensor:
        """Return the inputs of the terms, ``... x (S) x (1) x q x (d + k)``, at ``... x q x d``.

        There is a dimension for samples and one for outputs, where the model has them. Without
        basis the physics is not evaluated, and its columns are zero.
        """
        if self.training:
            self.eval()
        check_order(X, self.input_names)
        X = to_tensor(coded(X, self.levels, self.batches) if self.levels else X, "X")
        d = len(self.input_names)
        if X.dim() < 2 or X.shape[-1] != d:
            raise ValueError(
                f"Expected X with {d} columns, the inputs that the model was built on, and with at "
                f"least 2 dimensions (points x inputs), got shape {tuple(X.shape)}."
            )
        X = X if self.num_samples is None else X.unsqueeze(MCMC_DIM)
        X = X.unsqueeze(-3) if self._num_outputs > 1 else X
        transform = getattr(self, "input_transform", None)
        if isinstance(transform, PhysicsInput) and not with_basis:
            return transform.without_physics(X)
        return self.transform_inputs(X)

    def observation_noise(self, inputs: Tensor) -> Tensor:
        """The noise variances of observations at transformed inputs, ``... x (m) x q`` or 1.

        Of a model with known noise, the mean of that of its observations.
        """
        if self.noise.is_known:
            return self.noise.typical(self.measured())
        return self.noise.at(inputs)

    def measured(self) -> Tensor:
        """Return a mask of the targets that measure the function, ``... x (m) x n``."""
        return ~self.train_targets.isnan()

    def units(self, unit: Unit = Unit.TARGET) -> tuple[Tensor, Tensor]:
        """Shift and scale from the model's units to the user's, ``... x (m) x 1``."""
        transform = getattr(self, "outcome_transform", None)
        if transform is None:
            zero = self.train_inputs[0].new_zeros(*self._aug_batch_shape, 1)
            return zero, torch.ones_like(zero)
        shift, scale = self.outputs_first(transform.means), self.outputs_first(transform.stdvs)
        shift = shift if unit is Unit.TARGET else torch.zeros_like(shift)
        return shift, torch.ones_like(scale) if unit is Unit.NONE else scale

    def measured_targets(self) -> Tensor:
        """Targets as they were measured, in the model's units, ``... x (m) x n``.

        Those of ``train_targets`` are without what the noise of inputs adds to their mean.
        """
        noisy = getattr(self, "noisy_inputs", None)
        if noisy is None:
            return self.train_targets
        later = self.train_targets.shape[-1] - noisy.shift.shape[-1]
        return self.train_targets + pad(noisy.shift, (0, later))

    def user_targets(self) -> Tensor:
        """Targets in the user's units, ``... x n x m``."""
        shift, scale = self.units()
        targets = self.outputs_last(self.measured_targets() * scale + shift)
        return targets if self.link is None else self.link.inverse(targets)

    def outputs_last(self, values: Tensor) -> Tensor:
        """From ``... x (m) x q`` to ``... x q x m``."""
        return values.mT if self._num_outputs > 1 else values.unsqueeze(-1)

    def outputs_first(self, values: Tensor) -> Tensor:
        """From ``... x q x m`` to ``... x (m) x q``."""
        return values.mT if self._num_outputs > 1 else values.squeeze(-1)

    def _at(self, term: Term, inputs: Tensor) -> WeightedSum:
        """A term in the user's meaning at transformed inputs: a bias has no centers beside it."""
        parts: list[tuple[Term, Tensor | None]] = [(term, None)]
        shift: Tensor | float = 0.0
        for other in self._centerd() if term.unit is Unit.TARGET else ():
            parts.append((other, -other.basis.origin / other.basis.scale))
            shift = shift + other.basis.moved_mean
        return WeightedSum(inputs, parts, shift)

    def _centerd(self) -> list[Term]:
        """The terms from whose physics a center is taken."""
        scaled = [term for term in self.terms if isinstance(term.basis, AppendedPhysics)]
        return [t for t in scaled if t.basis.learns_center or t.basis.offset.any()]

    def _noise(self, inputs: Tensor, observation_noise: bool | Tensor) -> Tensor | None:
        """Noise variances ``... x (m) x q``, as given or in model units; None for none."""
        if observation_noise is False:
            return None
        if observation_noise is True:
            noise, wider = self.observation_noise(inputs), self.widening(inputs)
            return noise if wider is None or self.noise.is_known else noise * wider
        given = given_noise(observation_noise, inputs.shape[-2], self.num_outputs)
        given = given if self.num_samples is None else given.unsqueeze(MCMC_DIM)
        return self.outputs_first(given)

    def _graph_for(self, X: ArrayLike) -> torch.set_grad_enabled:
        """Make a graph only where inputs ask for one."""
        asks = isinstance(X, Tensor) and X.requires_grad
        asks = asks or self.train_inputs[0].requires_grad or detach_test_caches.off()
        return torch.set_grad_enabled(torch.is_grad_enabled() and asks)

    @classmethod
    def construct_inputs(cls, training_data: SupervisedDataset, **options: Any) -> dict[str, Any]:
        """Construct keyword arguments of the model from a dataset.

        Args:
            training_data: The data (of AR1, of the high level).
            options: Further arguments of the model: the physics and all others.

        Raises:
            ValueError: With a physics where Ax is loaded and :mod:`gpadjust.ax` is not, which tells
                a physics what Ax does to inputs and targets.
        """
        loaded = "ax" in sys.modules and "gpadjust.ax" not in sys.modules
        if loaded and options.get("physics") is not None:
            raise ValueError(
                "Ax transforms parameters and metrics before a model sees them, so that this "
                "physics would be asked in other units than its own. Import gpadjust.ax, and make "
                "the generation strategy by gpadjust.ax.generation_strategy({'the metric': f_p})."
            )
        return {**super().construct_inputs(training_data), **options}


def _is_plain(value: Any) -> bool:
    """Return whether a file can hold an option."""
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return isinstance(value, bool | int | float | str | Tensor | None)
