"""A SingleTaskGP with the ends tied that BoTorch leaves loose."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from copy import deepcopy
from typing import Any, Self

import torch
from botorch.acquisition.objective import PosteriorTransform
from botorch.models import SingleTaskGP
from botorch.models.transforms.outcome import Standardize
from botorch.models.utils import fantasize as fantasize_flag
from botorch.models.utils import gpt_posterior_settings
from botorch.posteriors import GPyTorchPosterior, Posterior
from botorch.posteriors.fully_bayesian import MCMC_DIM
from gpytorch.distributions import MultivariateNormal
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood
from gpytorch.models.exact_prediction_strategies import (
    DefaultPredictionStrategy,
    prediction_strategy,
)
from gpytorch.settings import (
    detach_test_caches,
    lazily_evaluate_kernels,
    min_variance,
    prior_mode,
)
from linear_operator import to_dense
from linear_operator.operators import DiagLinearOperator
from torch import Size, Tensor
from torch.nn import Module

from gpadjust.gp import FourierFeatures
from gpadjust.models.cholesky_strategy import CholeskyStrategy
from gpadjust.models.hyperparameter_samples import (
    HyperparameterMixture,
    HyperparameterSamples,
    mixture_moments,
)
from gpadjust.models.prediction import Prediction
from gpadjust.models.sampled_functions import (
    FunctionPerBatch,
    SampledFunctions,
    check_number,
    seeded,
)
from gpadjust.models.training_data import check_finite


class MultiOutputGP(HyperparameterSamples):
    """The base of this library's models: a ``SingleTaskGP`` with independent outputs.

    Beyond BoTorch's, a subset of its outputs can be fitted again, whatever its kernels and
    transforms; it can be conditioned on observations before any prediction was made, with
    gradients to where they are made; and ``output_indices`` may come in any order.
    """

    prediction_strategy: Any

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Copy as ever, in half the time: each module has a dozen empty dictionaries of hooks."""
        for module in self.modules():
            for value in vars(module).values():
                if type(value) is OrderedDict and not value:
                    memo[id(value)] = OrderedDict()
        new = memo[id(self)] = type(self).__new__(type(self))
        new.__setstate__(deepcopy(vars(self), memo))
        return new

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Evaluate the model at *transformed* inputs, as GPyTorch does."""
        if not self.training and self.train_inputs is not None and args:
            expected, found = self.train_inputs[0].shape[-1], args[0].shape
            if found[-1] != expected:
                raise ValueError(
                    f"In eval mode the model itself takes transformed inputs with {expected} "
                    f"columns, got shape {tuple(found)}. Call `model.posterior(X)` on raw inputs, "
                    "or `model(model.transform_inputs(X))`."
                )
        if not self.training and self.train_inputs is not None and prior_mode.off():
            self._remember_training_data()
        return super().__call__(*args, **kwargs)

    def posterior(
        self,
        X: Tensor,
        output_indices: list[int] | None = None,
        observation_noise: bool | Tensor = False,
        posterior_transform: PosteriorTransform | None = None,
    ) -> Posterior:
        """The posterior at raw ``X`` (``... x q x d``); see BoTorch."""
        if output_indices is not None and list(output_indices) != list(range(self.num_outputs)):
            # BoTorch would undo the outcome transform of all outputs on these.
            subset = self.subset_output(list(output_indices))
            return subset.posterior(X, None, observation_noise, posterior_transform)
        if self.num_samples is None:
            return super().posterior(X, None, observation_noise, posterior_transform)
        X, observation_noise = self._for_samples(X), self._for_samples(observation_noise)
        components = super().posterior(X, None, observation_noise, posterior_transform)
        if not isinstance(components, GPyTorchPosterior):
            raise NotImplementedError(
                "A model that holds samples needs posteriors that are Gaussian for each of them; "
                f"its transforms make a {type(components).__name__}."
            )
        return HyperparameterMixture(components)

    def predict(self, X: Tensor, observation_noise: bool | Tensor = False) -> Prediction:
        """Predict each point by itself, without the covariances between them.

        The mean and variance of ``posterior(X)``, from factors of the training covariance that are
        kept until the model is trained or given other data: much faster for many points, with
        memory linear in their number. Differentiable in ``X`` as far as f_p is. Of a model that
        holds samples of its hyper-parameters, the mean and variance of the mixture.

        Args:
            X: Raw inputs, ``batch_shape x q x d``.
            observation_noise: Whether to predict observations instead of the function; or their
                noise variances, ``batch_shape x q x m``, as in ``posterior``.

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
        self.eval()
        transform = getattr(self, "outcome_transform", None)
        self._remember_training_data()
        if not self._predicts_fast or not isinstance(transform, Standardize | None):
            noise = observation_noise
            noise = noise.unsqueeze(-2) if isinstance(noise, Tensor) else noise
            posterior = self.posterior(X.unsqueeze(-2), observation_noise=noise)
            if isinstance(posterior, HyperparameterMixture):
                moments = posterior.mixture_mean, posterior.mixture_variance
            else:
                moments = posterior.mean, posterior.variance
            return Prediction(*(moment.squeeze(-2) for moment in moments))
        inputs = self.transform_inputs(self._for_samples(X))
        observation_noise = self._for_samples(observation_noise)
        inputs = inputs.unsqueeze(-3) if self._num_outputs > 1 else inputs
        with gpt_posterior_settings():
            mean, variance = self._marginals(inputs)
            if observation_noise is not False:
                mvn = MultivariateNormal(mean, DiagLinearOperator(variance))
                with min_variance(double_value=0.0):
                    variance = self._apply_noise(inputs, mvn, observation_noise).variance
        mean, variance = (
            t.mT if self._num_outputs > 1 else t.unsqueeze(-1) for t in (mean, variance)
        )
        if transform is not None:
            mean, variance = transform.untransform(mean, variance)
        if self.num_samples is not None:
            mean, variance = mixture_moments(mean, variance)
        return Prediction(mean, variance)

    def sample_functions(self, num_functions: int, seed: int | None = None) -> Module:
        """Draw functions from the posterior, to be called anywhere.

        Of a model that holds samples of its hyper-parameters, the functions are spread over these.

        Args:
            num_functions: Number ``k`` of functions.
            seed: Seed of the draw. Default: go on with PyTorch's generator.

        Returns:
            A module that maps raw ``... x q x d`` to ``k x ... x q x m`` in the user's units.
            Later fits of the model leave it as it is.

        Raises:
            ValueError: If ``num_functions`` is not a positive whole number.
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
        check_number(num_functions, "num_functions")
        with seeded(seed):
            if self.num_samples is None:
                return self._draw_functions(num_functions)
            order = torch.randperm(self.num_samples)
            each = self._take_samples(order[torch.arange(num_functions) % self.num_samples])
            return FunctionPerBatch(each._draw_functions(1))

    def _draw_functions(self, num_functions: int) -> Module:
        """The functions that :meth:`sample_functions` returns, for each batch."""
        return SampledFunctions(self, num_functions, num_features=1024)

    def _marginals(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances ``... x (m) x q`` at transformed ``... x (1) x q x d``, no units."""
        (train,) = self.train_inputs
        batch_shape = torch.broadcast_shapes(train.shape[:-2], inputs.shape[:-2])
        inputs = inputs.expand(*batch_shape, *inputs.shape[-2:])
        with lazily_evaluate_kernels(False):
            variance = self.covar_module(inputs, diag=True)
            covariance = to_dense(
                self.covar_module(inputs, train.expand(*batch_shape, *train.shape[-2:]))
            )
        return self.prediction_strategy.marginals(
            self.mean_module(inputs), variance.expand(inputs.shape[:-1]), covariance
        )

    @property
    def _predicts_fast(self) -> bool:
        """Whether :meth:`_marginals` serves this model."""
        return isinstance(self.prediction_strategy, CholeskyStrategy)

    def _remember_training_data(self) -> None:
        """Make the prediction strategy, unless there is one; a kernel may bring its own."""
        if self.prediction_strategy is None:
            inputs = list(self.train_inputs)
            with lazily_evaluate_kernels():
                prior = self._get_train_prior_distribution(inputs)
            data = (inputs, prior, self.train_targets, self.likelihood)
            strategy = prediction_strategy(*data)
            exact = type(strategy) is DefaultPredictionStrategy
            self.prediction_strategy = CholeskyStrategy(*data) if exact else strategy

    @property
    def constant_means(self) -> dict[str, Callable[[Tensor], Tensor]]:
        """The unknown constants of the mean, none unless a model says otherwise.

        One that does has ``constant_mean_values`` and ``set_constant_means``, too.
        """
        return {}

    @property
    def _subset_batch_dict(self) -> dict[str, int]:
        """Where in each batched parameter and buffer the outputs lie, for ``subset_output``."""
        outputs: Size = self._aug_batch_shape
        if self.num_outputs == 1:
            return {}
        shared = {
            f"{name}.{buffer}"
            for name, module in self.named_modules()
            if isinstance(module, FourierFeatures)
            for buffer, _ in module.named_buffers()
        }
        dimensions = {}
        for part in ("mean_module", "covar_module", "likelihood"):
            module = getattr(self, part)
            for name, tensor in [*module.named_parameters(), *module.named_buffers()]:
                full_name = f"{part}.{name}"
                if tensor.shape[: len(outputs)] == outputs and full_name not in shared:
                    dimensions[full_name] = len(outputs) - 1 - tensor.dim()
        return dimensions

    def subset_output(self, idcs: list[int]) -> Self:
        """Subset the model along the outputs; see BoTorch."""
        subset = super().subset_output(idcs)
        original = subset._original_train_inputs
        if original is not None and len(idcs) < self.num_outputs:
            # BoTorch subsets the transformed inputs only, and a later fit starts from these.
            subset._original_train_inputs = original[..., idcs if len(idcs) > 1 else idcs[0], :, :]
        return subset

    def condition_on_observations(self, X: Tensor, Y: Tensor, **kwargs: Any) -> Self:
        """Condition on new observations; see BoTorch. No posterior has to be called before.

        The hyper-parameters stay, and with them the factors of the training covariance, to which
        ``k`` new points among ``n`` are appended in O(n^2 k).

        Args:
            X: Raw inputs, ``batch_shape x k x d``.
            Y: Observations, ``(f) x batch_shape x k x m``, in the user's units.
            kwargs: ``noise``, the variances of the new observations, if they are known.

        Raises:
            ValueError: If ``X`` or ``Y`` is not finite.
        """
        check_finite(X, "X")
        check_finite(Y, "Y")
        if isinstance(self.likelihood, FixedNoiseGaussianLikelihood) and "noise" not in kwargs:
            raise ValueError(
                "The model was built with known noise (train_Yvar), so that of new observations is "
                "needed, too: pass `noise`, variances of the shape of Y."
            )
        if self.num_samples is not None:
            # All samples see the same observations, unless these have a dimension for them, as
            # fantasies have.
            if fantasize_flag.on() or X.dim() == 2:
                X = X.unsqueeze(MCMC_DIM)
                X = X.expand(*X.shape[:MCMC_DIM], self.num_samples, *X.shape[-2:])
            if Y.dim() == 2:
                Y = Y.expand(self.num_samples, *Y.shape)
        self.eval()
        self._remember_training_data()
        if not isinstance(self.prediction_strategy, CholeskyStrategy):
            with torch.no_grad():
                SingleTaskGP.posterior(self, X)
        # GPyTorch would cut the gradient to X, which look-ahead acquisition functions need.
        with detach_test_caches(not X.requires_grad), lazily_evaluate_kernels():
            return super().condition_on_observations(X, Y, **kwargs)
