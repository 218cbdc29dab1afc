"""Turning a model into a batch of itself, one for each sample of its hyper-parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any, Self

import torch
from botorch.models import SingleTaskGP
from botorch.posteriors import GPyTorchPosterior
from botorch.posteriors.fully_bayesian import MCMC_DIM, GaussianMixturePosterior
from gpytorch.kernels import Kernel
from gpytorch.likelihoods.noise_models import FixedGaussianNoise
from gpytorch.settings import min_variance
from torch import Size, Tensor
from torch.nn import Parameter

from gpadjust.gp import PhysicsColumn


class HyperparameterMixture(GaussianMixturePosterior):
    """BoTorch's posterior of a fully Bayesian model, with variances right however small.

    Its moments are those of the components, ``batch_shape x S x q x m``; ``mixture_mean``,
    ``mixture_variance`` and ``quantile`` are those of the mixture, ``batch_shape x q x m``.

    Args:
        components: The posterior of a model that holds samples, with their dimension third from
            the right.
    """

    def __init__(self, components: GPyTorchPosterior) -> None:
        with min_variance(double_value=0.0):
            super().__init__(components.distribution)
        self._variance = components.variance

    @property
    def mixture_variance(self) -> Tensor:
        """The variance of the mixture, ``batch_shape x q x m``."""
        return mixture_moments(self._mean, self._variance)[1]


def mixture_moments(mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance ``... x q x m`` of mixtures of components ``... x S x q x m``."""
    # Not as a difference of second moments, which cancels.
    spread = mean.var(MCMC_DIM, correction=0)
    return mean.mean(MCMC_DIM), variance.mean(MCMC_DIM) + spread


_HOLDS_SAMPLES = "The model holds samples of its hyper-parameters already; build it anew to fit it."


class HyperparameterSamples(SingleTaskGP):
    """A model that may hold samples of its hyper-parameters, as a batch of itself."""

    num_samples: int | None = None  # of the hyper-parameters, which `fit(model, "hmc")` draws

    @property
    def _is_fully_bayesian(self) -> bool:
        """BoTorch's flag of models that hold samples of their hyper-parameters."""
        return self.num_samples is not None

    _is_ensemble = _is_fully_bayesian

    @property
    def num_mcmc_samples(self) -> int | None:
        """``num_samples``, under BoTorch's name."""
        return self.num_samples

    def hold_samples(self, samples: dict[str, Tensor]) -> None:
        """Make the model fully Bayesian: a batch of itself, one for each hyper-parameter sample.

        Its posterior then is a Gaussian mixture, as that of BoTorch's fully Bayesian models.
        :func:`gpadjust.fit` calls this.

        Args:
            samples: Raw parameters by their names, ``S x`` the parameter's shape.

        Raises:
            RuntimeError: If the model holds samples already.
            ValueError: If the model is of a batch of data sets.
        """
        self.check_can_hold_samples()
        (num_samples,) = {len(values) for values in samples.values()}
        _change(self, lambda tensor: tensor.expand(num_samples, *tensor.shape).clone())
        named = dict(self.named_parameters())
        with torch.no_grad():
            for name, values in samples.items():
                named[name].copy_(values)
        self.num_samples = num_samples

    def check_can_hold_samples(self) -> None:
        """Raise what :meth:`hold_samples` raises."""
        if self.num_samples is not None:
            raise RuntimeError(_HOLDS_SAMPLES)
        if self._input_batch_shape:
            raise ValueError(
                "Expected a model of one data set to hold samples, got one with batch_shape "
                f"{tuple(self._input_batch_shape)}; sample the data sets of a batch one by one."
            )

    def train(self, mode: bool = True) -> Self:
        """Put the model in train mode, or eval mode; one that holds samples is not trained."""
        if mode and self.num_samples is not None:
            raise RuntimeError(_HOLDS_SAMPLES)
        return super().train(mode)

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, *args: Any, **kwargs: Any
    ) -> Any:
        """Load parameters; with those of a model that holds samples, this one holds them too."""
        samples = {
            name: state_dict[name]
            for name, parameter in self.named_parameters()
            if name in state_dict and state_dict[name].dim() > parameter.dim()
        }
        if samples:
            self.hold_samples(samples)
        return super().load_state_dict(state_dict, strict, *args, **kwargs)

    def _take_samples(self, index: Tensor) -> Self:
        """A copy whose batch is some of the samples, maybe repeated; a plain batch to BoTorch."""
        model = deepcopy(self)
        fixed = getattr(model.likelihood, "noise_covar", None)
        if isinstance(fixed, FixedGaussianNoise):
            # The samples share the noise of the training data, but not that of later observations.
            shape = (*model._aug_batch_shape, fixed.noise.shape[-1])
            fixed.noise = fixed.noise.expand(shape)[index]
        _change(model, lambda tensor: tensor[index])
        model.num_samples = None
        return model

    def _for_samples(self, value: Any) -> Any:
        """Insert the dimension of the samples into a tensor ``... x q x d``, if there are any."""
        if self.num_samples is None or not isinstance(value, Tensor):
            return value
        return value.unsqueeze(MCMC_DIM)


def _change(model: Any, change: Callable[[Tensor], Tensor]) -> None:
    """Change the leading dimensions of all that a model has for each of its batches."""
    outputs = model._aug_batch_shape

    def changed(shape: Size) -> Size:
        return change(torch.empty(shape, device="meta")).shape

    model.eval()
    for path, module in model.named_modules():
        if path.partition(".")[0] not in ("mean_module", "covar_module", "likelihood"):
            continue
        if isinstance(module, Kernel) and module._batch_shape[: len(outputs)] == outputs:
            module._batch_shape = changed(module._batch_shape)
        elif isinstance(module, PhysicsColumn):
            for name, buffer in module.named_buffers(recurse=False):
                setattr(module, name, change(buffer))
        for name, parameter in list(module.named_parameters(recurse=False)):
            if parameter.shape[: len(outputs)] == outputs:
                learnt = parameter.requires_grad
                setattr(module, name, Parameter(change(parameter.detach()), requires_grad=learnt))
    with torch.no_grad():
        model.train_inputs = tuple(change(t) for t in model.train_inputs)
        if model._original_train_inputs is not None:
            model._original_train_inputs = change(model._original_train_inputs)
        model.train_targets = change(model.train_targets)
    model._input_batch_shape = changed(model._input_batch_shape)
    model._aug_batch_shape = changed(outputs)
    model.prediction_strategy = None
