"""What a model that is a sum of terms predicts, however it learnt it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from inspect import signature
from typing import Any, NamedTuple, Self

import torch
from botorch.acquisition.objective import PosteriorTransform
from botorch.models.model import Model
from botorch.models.utils import fantasize as fantasize_flag
from botorch.posteriors import Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM
from botorch.utils.datasets import SupervisedDataset
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood
from linear_operator import to_dense
from torch import Tensor
from torch.nn import Module

from gpadjust.gp import PhysicsInput, SumOfTerms, Term
from gpadjust.gp.gaussian import noise_variances, threads_for
from gpadjust.models.cholesky_strategy import Weights
from gpadjust.models.posteriors import (
    HyperparameterMixture,
    ScaleFreePosterior,
    mixture_interval,
    mixture_moments,
)
from gpadjust.models.sampled_functions import SampledFunctions, draw_functions, mean_functions
from gpadjust.models.summary import log_likelihood, summary, title
from gpadjust.models.training_data import ArrayLike, check_columns, to_tensor


class Prediction(NamedTuple):
    """Marginal predictions, as :meth:`~gpadjust.CKA.predict` returns them.

    Args:
        mean: Posterior means, ``batch_shape x q x m``, in the units of the targets.
        variance: Posterior variances, ``batch_shape x q x m``, in their square.
    """

    mean: Tensor
    variance: Tensor


class TermsModel(Model):
    r"""A BoTorch model of a sum of terms, :math:`f(x) = \sum_t b_t(x) g_t(x)`: its predictions.

    All of them are those of a weighted sum of the terms, of which a ``strategy`` knows what the
    data say (:class:`~gpadjust.models.cholesky_strategy.CholeskyStrategy`). It is the base of exact
    models and of variational ones, beside BoTorch's own of each.

    Attributes:
        covar_module: The covariance of the sum, which holds the terms.
        num_samples: The number of samples of the hyper-parameters that :func:`~gpadjust.fit` drew,
            or None.
        input_names: The names of the inputs.
        output_names: The names of the outputs.
        train_targets: Targets in the model's units, ``batch_shape x (m) x n``; NaN where one is
            missing.
    """

    covar_module: SumOfTerms
    num_samples: int | None = None
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    train_inputs: Any
    train_targets: Tensor
    likelihood: Any
    strategy: Any
    _num_outputs: int
    _aug_batch_shape: Any

    def __new__(cls, *args: Any, **options: Any) -> Self:
        """Remember the options that the model is built with, for :func:`gpadjust.save`."""
        model = super().__new__(cls)
        names = [*signature(cls.__init__).parameters][1:]
        every = {**dict(zip(names, args, strict=False)), **options}
        every = {n: v for n, v in every.items() if not n.startswith(("train_", "low_", "physics"))}
        # Others than plain values are told by name alone, or they would have to pickle.
        model.__dict__["options"] = {n: v for n, v in every.items() if _is_plain(v)}
        model.__dict__["objects"] = [n for n, v in every.items() if not _is_plain(v)]
        return model

    def __repr__(self) -> str:
        """One line; :meth:`summary` says more."""
        return title(self)

    def summary(self) -> str:
        """What the model has learnt, as a text in the user's units.

        The structure; unknown parameters of the physics; the log marginal likelihood; means,
        standard deviations and lengthscales of the terms; the noise as a standard deviation; and
        what is at a bound. Of a model that holds samples, their medians and the ranges of 95 % of
        them.
        """
        return summary(self)

    def _evidence(self) -> tuple[str, Tensor | None]:
        """What says how well the model explains its data, and how much it is, ``... x (m)``."""
        return "log likelihood", log_likelihood(self)

    @property
    def terms(self) -> Sequence[Term]:
        """The terms of the sum."""
        terms: Sequence[Term] = self.covar_module.terms
        return terms

    @property
    def has_unknowns(self) -> bool:
        """Whether its physics has unknown parameters."""
        transform = getattr(self, "input_transform", None)
        return isinstance(transform, PhysicsInput) and bool(transform.physics.unknowns)

    @property
    def term_names(self) -> tuple[str, ...]:
        """The names of the terms that are unknown, for :meth:`term`."""
        return tuple(term.name for term in self.terms if not term.is_known)

    def posterior(
        self,
        X: ArrayLike,
        output_indices: list[int] | None = None,
        observation_noise: bool | Tensor = False,
        posterior_transform: PosteriorTransform | None = None,
    ) -> Posterior:
        """The joint posterior at raw ``X`` (``batch_shape x q x d``); see BoTorch.

        Variances that are given as ``observation_noise`` are in the square of the user's units.
        """
        if output_indices is not None and list(output_indices) != list(range(self.num_outputs)):
            subset = self.subset_output(list(output_indices))
            return subset.posterior(X, None, observation_noise, posterior_transform)
        inputs = self.model_inputs(X)
        mean, covariance = self._joint(inputs, self._bases(inputs))
        noise = self._noise(inputs, observation_noise)
        if noise is not None:
            covariance = covariance + torch.diag_embed(noise.expand(mean.shape))
        posterior = self._as_posterior(mean, covariance, *self._units())
        if posterior_transform is None:
            return posterior
        return ScaleFreePosterior.transformed(posterior_transform(posterior=posterior, X=X))

    def term(self, name: str, X: ArrayLike) -> Posterior:
        """The posterior of a term's Gaussian process; its basis is not evaluated.

        Args:
            name: One of ``term_names``.
            X: Raw inputs, ``batch_shape x q x d``.

        Returns:
            A posterior over ``batch_shape x q x m``: of a rho without units, else in those of the
            targets.

        Raises:
            ValueError: If there is no such term.
        """
        weights, inputs = self._term_weights(name), self.model_inputs(X, with_basis=False)
        return self._as_posterior(*self._joint(inputs, weights), *self._term_units(name))

    def predict(self, X: ArrayLike, observation_noise: bool | Tensor = False) -> Prediction:
        """Predict each point by itself, without the covariances between them.

        The mean and variance of ``posterior(X)``, from factors of the training covariance that are
        kept until the model is trained or given other data: much faster for many points, with
        memory linear in their number. Differentiable in ``X`` as far as f_p is. Of a model that
        holds samples of its hyper-parameters, the mean and variance of the mixture.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            observation_noise: Whether to predict observations instead of the function; or their
                noise variances, ``batch_shape x q x m``, in the square of the user's units.

        Returns:
            The mean and the variance, ``batch_shape x q x m`` each, in the user's units.

        Raises:
            TypeError: If ``X`` is not float64.
            ValueError: If ``X`` has not the columns that the model was built on.
            PhysicsError: If the physics fails at ``X``.

        Example:
            >>> import torch
            >>> from gpadjust import CKA
            >>> train_X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
            >>> model = CKA(train_X, train_X.sin(), physics=lambda X: X)
            >>> mean, variance = model.predict(torch.rand(1000, 1, dtype=torch.float64))
            >>> mean.shape
            torch.Size([1000, 1])
        """
        mean, variance = self.components(X, observation_noise)
        if self.num_samples is None:
            return Prediction(mean.squeeze(MCMC_DIM), variance.squeeze(MCMC_DIM))
        return Prediction(*mixture_moments(mean, variance))

    def components(self, X: ArrayLike, observation_noise: bool | Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances for each sample of the hyper-parameters, ``... x S x q x m``."""
        inputs = self.model_inputs(X)
        with threads_for(self.train_targets.shape[-1]):
            mean, variance = self._marginals(inputs, self._bases(inputs))
        noise = self._noise(inputs, observation_noise)
        variance = variance if noise is None else variance + noise
        # Fantasies share their variances.
        mean, variance = torch.broadcast_tensors(mean, variance)
        shift, scale = self._units()
        mean, variance = (
            self._outputs_last(each) for each in (mean * scale + shift, variance * scale.square())
        )
        if self.num_samples is None:
            mean, variance = mean.unsqueeze(MCMC_DIM), variance.unsqueeze(MCMC_DIM)
        return mean, variance

    def _outputs_last(self, values: Tensor) -> Tensor:
        """From ``... x (m) x q`` to ``... x q x m``."""
        return values.mT if self._num_outputs > 1 else values.unsqueeze(-1)

    def _outputs_first(self, values: Tensor) -> Tensor:
        """From ``... x q x m`` to ``... x (m) x q``."""
        return values.mT if self._num_outputs > 1 else values.squeeze(-1)

    def interval(
        self, X: ArrayLike, level: float = 0.95, observation_noise: bool | Tensor = False
    ) -> tuple[Tensor, Tensor]:
        """The central interval at each point by itself.

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

    def sample_functions(
        self, num_functions: int, seed: int | None = None, num_features: int = 1024
    ) -> Module:
        """Draw functions from the posterior, to be called anywhere.

        Of a model that holds samples of its hyper-parameters, the functions are spread over these.

        Args:
            num_functions: Number ``k`` of functions.
            seed: Seed of the draw. Default: go on with PyTorch's generator.
            num_features: Number of random features that stand for each kernel, an even one. The
                more, the nearer is the functions' spread to the posterior's standard deviation;
                the time of a call is linear in it.

        Returns:
            A module that maps raw ``... x q x d`` to ``k x ... x q x m`` in the user's units.
            Later fits of the model leave it as it is.

        Raises:
            ValueError: If a number is not a positive whole one.
            NotImplementedError: If BoTorch knows no features of a kernel of yours.

        Example:
            >>> import torch
            >>> from gpadjust import CKA
            >>> train_X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
            >>> model = CKA(train_X, train_X.sin(), physics=lambda X: X)
            >>> functions = model.sample_functions(3, seed=0)
            >>> functions(torch.rand(5, 1, dtype=torch.float64)).shape
            torch.Size([3, 5, 1])
        """
        return draw_functions(self, num_functions, seed, num_features)

    def mean_functions(self, most: int | None = None) -> Module:
        """The posterior mean, as a function to be called anywhere: faster than ``predict``.

        Args:
            most: The most samples of the hyper-parameters to take, evenly of those held. Default:
                all.

        Returns:
            A module that maps raw ``... x q x d`` to ``S x ... x q x m`` in the user's units: a
            mean for each sample of the hyper-parameters, or a single one. Gradients flow to the
            inputs as far as f_p allows. Later fits of the model leave it as it is.

        Raises:
            ValueError: If ``most`` is no whole number of at least 1.
        """
        return mean_functions(self, most)

    def _mean_functions(self) -> Module:
        """The functions of :meth:`mean_functions`, for each batch of the model."""
        return SampledFunctions.mean(self)

    def _draw_functions(self, num_functions: int, num_features: int) -> Module:
        """The functions of :meth:`sample_functions`, for each batch of the model."""
        return SampledFunctions.by_matheron(self, num_functions, num_features)

    def model_inputs(self, X: ArrayLike, with_basis: bool = True) -> Tensor:
        """What the terms read, ``... x (S) x (1) x q x (d + k)``, of raw ``X``, ``... x q x d``.

        There is a dimension for samples and one for outputs, where the model has them. Without
        basis the physics is not evaluated, and its columns are zero.
        """
        if self.training:
            self.eval()
        check_columns(X, self.input_names)
        X = to_tensor(X, "X")
        if X.dim() < 2:
            raise ValueError(
                f"Expected X with at least 2 dimensions (points x inputs), got {tuple(X.shape)}."
            )
        X = X if self.num_samples is None else X.unsqueeze(MCMC_DIM)
        X = X.unsqueeze(-3) if self._num_outputs > 1 else X
        inputs = self.transform_inputs(X) if with_basis else self._inputs_without_basis(X)
        if inputs.shape[-1] != self.train_inputs[0].shape[-1]:
            raise ValueError(
                f"Expected X with the {len(self.input_names)} columns that the model was built on, "
                f"got shape {tuple(X.shape)}."
            )
        return inputs

    def check_transformed(self, inputs: Tensor) -> None:
        """Raise a ValueError if inputs of the model itself, in eval mode, are not transformed."""
        expected = self.train_inputs[0].shape[-1]
        if inputs.shape[-1] != expected:
            raise ValueError(
                f"In eval mode the model itself takes transformed inputs with {expected} columns, "
                f"got shape {tuple(inputs.shape)}. Call `model.posterior(X)` on raw inputs, or "
                "`model(model.transform_inputs(X))`."
            )

    def _inputs_without_basis(self, X: Tensor) -> Tensor:
        return self.transform_inputs(X)

    def _term_weights(self, name: str, or_known: bool = False) -> Weights:
        """A user's term as a weighted sum of the model's; of an unknown one if not said."""
        found = [t for t in self.terms if t.name == name and (or_known or not t.is_known)]
        if not found:
            raise ValueError(
                f"{type(self).__name__} has no unknown term {name!r}; it has "
                f"{', '.join(map(repr, self.term_names))}."
            )
        return [(found[0], None)]

    def _term_units(self, name: str) -> tuple[Tensor, Tensor]:
        """Shift and scale from the model's units of a term to the user's."""
        shift, scale = self._units()
        return torch.zeros_like(shift), scale

    def _bases(self, inputs: Tensor) -> Weights:
        """The function itself as a weighted sum of the terms."""
        return [(term, term.weights(inputs)) for term in self.terms]

    def _joint(self, inputs: Tensor, weights: Weights) -> tuple[Tensor, Tensor]:
        """Mean ``... x (m) x q`` and covariance of a weighted sum of terms, in model units."""
        q = inputs.shape[-2]
        strategy, prior = self.strategy(), inputs.new_zeros(q, q)
        for term, weight in weights:
            if not term.is_known:
                part = term.covariance(inputs, inputs)
                if weight is not None:
                    part = part * weight.unsqueeze(-1) * weight.unsqueeze(-2)
                prior = prior + part
        cross = strategy.cross_covariance(inputs, weights)
        mean = strategy.exact_predictive_mean(self._prior_mean(inputs, weights), cross)
        covariance = to_dense(strategy.exact_predictive_covar(prior, cross))
        return mean, covariance.expand(*mean.shape, mean.shape[-1])

    def _marginals(self, inputs: Tensor, weights: Weights) -> tuple[Tensor, Tensor]:
        """As :meth:`_joint`, with the variances only."""
        return self.strategy().marginals(inputs, weights, self._prior_mean(inputs, weights))

    @staticmethod
    def _prior_mean(inputs: Tensor, weights: Weights) -> Tensor:
        """The prior mean of a weighted sum of terms, ``... x (m) x q``."""
        parts = [
            term.mean if weight is None else weight * term.mean + term.moved_mean
            for term, weight in weights
        ]
        total: Tensor = sum(parts, torch.zeros_like(inputs[..., 0]))
        return total

    def observation_noise(self, inputs: Tensor) -> Tensor:
        """The noise variances of observations at transformed inputs, ``... x (m) x q`` or 1."""
        if isinstance(self.likelihood, FixedNoiseGaussianLikelihood):
            return self._typical_noise()
        return noise_variances(self.likelihood, inputs)

    def _noise(self, inputs: Tensor, observation_noise: bool | Tensor) -> Tensor | None:
        """Noise variances ``... x (m) x q`` of observations, in model units, or None for none."""
        if observation_noise is False:
            return None
        if isinstance(observation_noise, Tensor):
            given = observation_noise
            given = given if self.num_samples is None else given.unsqueeze(MCMC_DIM)
            expected = (inputs.shape[-2], self.num_outputs)
            if given.dim() < 2 or any(
                have not in (1, want) for have, want in zip(given.shape[-2:], expected, strict=True)
            ):
                raise ValueError(
                    "Expected observation_noise as True, False, or variances of shape ... x "
                    f"{expected[0]} x {expected[1]}, got shape {tuple(observation_noise.shape)}."
                )
            given = self._outputs_first(given)
            # In the user's units; those that BoTorch makes fantasies with are in the model's.
            return given if fantasize_flag.on() else given / self._units()[1].square()
        if observation_noise is not True:
            raise TypeError(
                "Expected observation_noise as True, False, or a tensor of variances, got "
                f"{observation_noise!r}; known noise belongs to the model (train_Yvar)."
            )
        return self.observation_noise(inputs)

    def _typical_noise(self) -> Tensor:
        """The mean of the known noise of the observations, ``... x (m) x 1``."""
        observed = ~self.train_targets.isnan()
        noise = self.likelihood.noise * observed
        return noise.sum(-1, keepdim=True) / observed.sum(-1, keepdim=True)

    def _units(self) -> tuple[Tensor, Tensor]:
        """Shift and scale from model units to the user's, ``... x (m) x 1``."""
        transform = getattr(self, "outcome_transform", None)
        if transform is None:
            zero = self.train_targets.new_zeros(*self._aug_batch_shape, 1)
            return zero, torch.ones_like(zero)
        return self._outputs_first(transform.means), self._outputs_first(transform.stdvs)

    def _as_posterior(
        self, mean: Tensor, covariance: Tensor, shift: Tensor, scale: Tensor
    ) -> Posterior:
        """The posterior of independent outputs in the user's units."""
        mean, covariance = mean * scale + shift, covariance * scale.square().unsqueeze(-1)
        posterior = ScaleFreePosterior.of_outputs(mean, covariance, self._num_outputs > 1)
        return posterior if self.num_samples is None else HyperparameterMixture(posterior)

    @property
    def num_mcmc_samples(self) -> int | None:
        """``num_samples``, under BoTorch's name."""
        return self.num_samples

    @classmethod
    def construct_inputs(cls, training_data: SupervisedDataset, **options: Any) -> dict[str, Any]:
        """Construct keyword arguments of the model from a dataset.

        Args:
            training_data: The data (of AR1, of the high level).
            options: Further arguments of the model: the physics and all others.

        Raises:
            ValueError: If Ax calls this with a physics, without :mod:`gpadjust.ax`, which tells a
                physics what Ax did to inputs and targets.
        """
        caller = sys._getframe(1).f_globals.get("__name__", "")
        if caller.startswith("ax.") and options.get("physics") is not None:
            raise ValueError(
                "Ax transforms parameters and metrics before a model sees them, so that this "
                "physics would be asked in other units than its own. Import gpadjust.ax, and make "
                "the generation strategy by gpadjust.ax.generation_strategy({'the metric': f_p})."
            )
        return {**super().construct_inputs(training_data), **options}


def _is_plain(value: Any) -> bool:
    """Whether a file can hold an option."""
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return isinstance(value, bool | int | float | str | Tensor | None)
