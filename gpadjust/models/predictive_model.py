"""Predictions of all models: marginals, intervals, joint posteriors and functions."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Generic, NamedTuple, TypeVar, overload

from botorch.acquisition.objective import PosteriorTransform
from botorch.models.model import Model
from botorch.posteriors import Posterior
from torch import Tensor
from torch.nn import Module

from gpadjust.checks import check_level, checked_whole
from gpadjust.models.levels import Levels
from gpadjust.models.posteriors import (
    HyperparameterMixture,
    MarginalMixture,
    ScaleFreePosterior,
    mixture_moments,
    mixture_quantile,
)
from gpadjust.models.sampled_functions import DRAWING, check_num_features, seeded
from gpadjust.models.training_data import ArrayLike, as_given

Values = TypeVar("Values")


class Prediction(NamedTuple, Generic[Values]):
    """Marginal predictions, as :meth:`~gpadjust.CKA.predict` returns them.

    Args:
        mean: Posterior means, ``batch_shape x q x m``, in the units of the targets.
        variance: Posterior variances, ``batch_shape x q x m``, in their square.
    """

    mean: Values
    variance: Values


class PredictiveModel(Model):
    """A BoTorch model whose predictions are mixtures of ``S`` Gaussians, or of one.

    Its numbers come as the inputs came: of tensors as tensors; of NumPy arrays as arrays; of pandas
    and polars frames as frames, with the names of the outputs and the index of the inputs. All are
    in the user's units. Posteriors are BoTorch's, and so of tensors.

    Attributes:
        num_samples: Number ``S`` of Gaussians; None for a single one.
        input_names: The names of the inputs.
        output_names: The names of the outputs.
        levels: The levels of categorical inputs by the numbers of their columns, texts or numbers;
            ``batches`` are the columns in which others are new levels.
        link: The link of which :meth:`components` are, a :class:`Logit`; None without one.
    """

    link: Any = None

    levels: Levels = {}  # noqa: RUF012
    batches: tuple[int, ...] = ()
    num_samples: int | None = None
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]

    def components(self, X: ArrayLike, observation_noise: bool | Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances of each of the Gaussians, ``... x S x q x m``."""
        raise NotImplementedError

    def joint_moments(
        self, X: ArrayLike, observation_noise: bool | Tensor
    ) -> tuple[Tensor, Tensor]:
        """Means ``... x (S) x (m) x q`` and covariances ``... x (S) x (m) x q x q``."""
        raise NotImplementedError

    def draw_functions(self, num_functions: int, num_features: int) -> Module:
        """The functions of :meth:`sample_functions`."""
        raise NotImplementedError

    def update(self, X: ArrayLike, Y: ArrayLike, *args: Any, **options: Any) -> None:
        """Refuse: exact models take new observations in place, see :meth:`CKA.update`."""
        raise NotImplementedError(
            f"A {type(self).__name__} takes no observations in place: build it of all data and fit "
            "it again, or take an RRA, or an exact CKA of some hundred."
        )

    def posterior(
        self,
        X: ArrayLike,
        output_indices: list[int] | None = None,
        observation_noise: bool | Tensor = False,
        posterior_transform: PosteriorTransform | None = None,
    ) -> Posterior:
        """The joint posterior at raw ``X`` (``batch_shape x q x d``); see BoTorch.

        Variances that are given as ``observation_noise`` are, as in BoTorch, those of the targets
        after ``outcome_transform``; :meth:`predict` takes them in the user's units.
        """
        if output_indices is not None and list(output_indices) != list(range(self.num_outputs)):
            noise, subset = observation_noise, self.subset_output(list(output_indices))
            if isinstance(noise, Tensor) and noise.shape[-1] > 1:
                noise = noise[..., list(output_indices)]
            return subset.posterior(X, None, noise, posterior_transform)
        posterior = self.as_posterior(*self.joint_moments(X, observation_noise))
        if self.link is not None:
            posterior = self.link.posterior(posterior)
        if posterior_transform is None:
            return posterior
        return ScaleFreePosterior.transformed(posterior_transform(posterior=posterior, X=X))

    @overload
    def predict(
        self, X: Tensor, observation_noise: bool | Tensor = False
    ) -> Prediction[Tensor]: ...

    @overload
    def predict(
        self, X: ArrayLike, observation_noise: bool | Tensor = False
    ) -> Prediction[Any]: ...

    def predict(self, X: ArrayLike, observation_noise: bool | Tensor = False) -> Prediction[Any]:
        """Predict each point by itself, without the covariances between them.

        The mean and variance of ``posterior(X)`` (of a model that holds samples of its
        hyper-parameters, of the mixture), much faster for many points, with memory linear in their
        number. Differentiable in ``X`` as far as f_p is, and without a graph unless ``X`` asks for
        one.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            observation_noise: Whether to predict observations instead of the function; or their
                noise variances, ``batch_shape x q x m``, in the square of the user's units.

        Returns:
            Mean and variance, as ``X`` came: tensors, arrays or frames.

        Raises:
            TypeError: If ``X`` is a tensor that is not float64, or holds no numbers.
            ValueError: If ``X`` has not the columns that the model was built on, or a variance is
                negative.
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
        if self.link is not None:
            mean, variance = self.link.moments(mean, variance)
        moments = mixture_moments(mean, variance)
        return Prediction(*(as_given(each, X, self.output_names) for each in moments))

    def interval(
        self, X: ArrayLike, level: float = 0.95, observation_noise: bool | Tensor = False
    ) -> tuple[Any, Any]:
        """The central interval at each point by itself: lower and upper ends, as ``X`` came.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            level: The probability that it holds; a ValueError if it is not between 0 and 1.
            observation_noise: As in :meth:`predict`.
        """
        check_level(level)
        parts, link = self.components(X, observation_noise), self.link
        lower, upper = (mixture_quantile(*parts, (1 + s * level) / 2, link) for s in (-1, 1))
        return as_given(lower, X, self.output_names), as_given(upper, X, self.output_names)

    def plot(self, **options: Any) -> Any:
        """Draw predictions and adjustments along each input: what one wants to see first.

        See :func:`~gpadjust.validation.plots.plot_model`, whose options these are, as ``output``,
        ``level``, ``base`` (where the other inputs stay) and ``bounds``.

        Returns:
            An array of axes, ``rows x d``; ``axes[0, 0].figure`` is the figure.

        Raises:
            ImportError: Without matplotlib, ``pip install "gpadjust[plot]"``.
        """
        try:  # a room below, which is asked for at the call
            plots = import_module("gpadjust.validation.plots")
        except ImportError as error:
            raise ImportError(
                'model.plot() needs matplotlib; run `pip install "gpadjust[plot]"`.'
            ) from error
        return plots.plot_model(self, **options)

    def sample_functions(
        self, num_functions: int, seed: int | None = None, num_features: int = 1024
    ) -> Module:
        """Draw functions from the posterior, to be called anywhere.

        Of a mixture, the functions are spread over its Gaussians.

        Args:
            num_functions: Number ``k`` of functions.
            seed: Seed of the draw. Default: go on with PyTorch's generator.
            num_features: Number of random features that stand for each kernel, an even one; the
                time of a call is linear in it, and the functions' spread the more accurate.

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
        checked_whole("num_functions", num_functions, 1)
        check_num_features(num_features)
        self.eval()
        with DRAWING, seeded(None if seed is None else checked_whole("seed", seed)):
            return self.draw_functions(num_functions, num_features)

    @property
    def num_mcmc_samples(self) -> int | None:
        """``num_samples``, under BoTorch's name."""
        return self.num_samples

    def as_posterior(self, mean: Tensor, covariance: Tensor, mixed: bool = False) -> Posterior:
        """The posterior of independent outputs, of moments as in :meth:`joint_moments`.

        With ``mixed``, moments of a mixture are those of the whole, without a dimension for ``S``.
        """
        posterior = ScaleFreePosterior.of_outputs(mean, covariance, self.num_outputs > 1)
        if self.num_samples is None:
            return posterior
        return MarginalMixture(posterior) if mixed else HyperparameterMixture(posterior)

    def checked_outputs(self, idcs: Any) -> list[int]:
        """Numbers of outputs, for ``subset_output``; negative ones count from the end."""
        m = self.num_outputs
        if not idcs or any(not isinstance(i, int) or not -m <= i < m for i in idcs):
            raise ValueError(
                f"Expected numbers of outputs from 0 to {m - 1} (one at least), got {idcs}."
            )
        return [i % m for i in idcs]


def given_noise(noise: Any, num_points: int, num_outputs: int) -> Tensor:
    """Variances that are given as ``observation_noise``, ``... x q x m``, checked."""
    if not isinstance(noise, Tensor):
        raise TypeError(
            "Expected observation_noise as True, False, or a tensor of variances, got "
            f"{noise!r}; known noise belongs to the model (train_Yvar)."
        )
    expected = (num_points, num_outputs)
    if noise.dim() < 2 or any(
        have not in (1, want) for have, want in zip(noise.shape[-2:], expected, strict=True)
    ):
        raise ValueError(
            "Expected observation_noise as True, False, or variances of shape ... x "
            f"{expected[0]} x {expected[1]}, got shape {tuple(noise.shape)}."
        )
    if not (noise.isfinite() & (noise >= 0)).all():
        raise ValueError(
            "Expected observation_noise (variances) to be finite and not negative, found "
            f"{float(noise.min()):.3g} to {float(noise.max()):.3g}."
        )
    return noise
