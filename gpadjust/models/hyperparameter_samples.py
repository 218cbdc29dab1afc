"""Turning a model into a batch of itself, one for each sample of its hyper-parameters."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import torch
from gpytorch.kernels import Kernel, RFFKernel
from gpytorch.likelihoods.noise_models import FixedGaussianNoise
from torch import Size, Tensor
from torch.nn import Parameter

from gpadjust.gp import AppendedPhysics, Term
from gpadjust.gp.kernels import CompositeKernel
from gpadjust.gp.noise import RowNoise
from gpadjust.models.parameters import SIZES, hyperparameters
from gpadjust.models.relative_noise import RelativeNoise
from gpadjust.models.updates import UpdatedWeights

HOLDS_SAMPLES = (
    "The model holds samples of its hyper-parameters; `gpadjust.fit` lets go of them, "
    "`model.release_samples()` keeps the first."
)
NONE = 1e-20  # variance of a function that is switched off, in its typical size
_OFF = 1e-16  # the same, below which it is
# Modules whose buffers have the batch.
_BATCHED = (
    AppendedPhysics,
    CompositeKernel,
    RFFKernel,
    RelativeNoise,
    RowNoise,
    Term,
    UpdatedWeights,
)


def hold_samples(model: Any, samples: dict[str, Tensor]) -> None:
    """Make a model a batch of itself, one for each sample; see :meth:`TermsGP.hold_samples`."""
    (num_samples,) = {len(values) for values in samples.values()}
    _change(model, lambda tensor: tensor.expand(num_samples, *tensor.shape).clone(), num_samples)
    match_parameters(model)
    named = dict(model.named_parameters())
    with torch.no_grad():
        for name, values in samples.items():
            named[name].copy_(values.reshape(named[name].shape))
    transform_training_inputs(model)


def release_samples(model: Any) -> None:
    """Reverse :func:`hold_samples`, with the first sample; see :meth:`TermsGP.release_samples`."""
    if model.train_targets.dim() > len(model._aug_batch_shape) + 1:
        raise RuntimeError(
            "A model of fantasies cannot drop its samples; take the model that the fantasies were "
            "made of."
        )
    _change(model, lambda tensor: tensor[0], None)
    with torch.no_grad():
        for term in model.terms:  # which samples without the physics do not have
            if not term.learns_mean:
                term.mean.copy_(term.given_mean)
    if model.has_unknowns:
        _set_coordinates(model, model.input_transform.coordinates.flatten())


def take_samples(model: Any, index: Tensor, as_mixture: bool = False) -> Any:
    """A copy whose batch is some of the samples, maybe repeated.

    To BoTorch it is a plain batch, or a fully Bayesian model of these samples, ``as_mixture``.
    """
    model = deepcopy(model)
    _change(model, lambda tensor: tensor[index], len(index) if as_mixture else None)
    return model


@torch.no_grad()
def uses_physics(model: Any) -> Tensor:
    """Mask of the samples of a model that have its physics; ``S x batch_shape x (m)``."""
    known = [term for term in model.terms if not term.learns_mean]
    same = [(term.mean == term.given_mean).squeeze(-1) for term in known]
    return torch.stack(same).all(0) if same else model.terms[0].mean.squeeze(-1).isfinite()


@torch.no_grad()
def adjusts(model: Any) -> Tensor:
    """Mask of the samples of a model that have functions; of the others the physics is alone.

    It is ``S x batch_shape x (m)``.
    """
    mask = torch.ones_like(model.terms[0].mean.squeeze(-1), dtype=torch.bool)
    off = [
        (row.parameter(row.raw) <= _OFF * row.size).reshape(mask.shape)
        for row in hyperparameters(model)
        if row.kind in SIZES and row.size is not None
    ]
    return ~torch.stack(off).all(0) if off else mask


@torch.no_grad()
def let_all_learn(model: Any) -> None:
    """Replace samples of the physics alone by copies of those with functions, in place."""
    if model.num_samples is None:
        return
    learn = adjusts(model).reshape(model.num_samples, -1).all(-1)
    rows = learn.nonzero().flatten()
    if 0 < len(rows) < len(learn):
        index = rows[torch.arange(len(learn), device=rows.device) % len(rows)]
        _change(model, lambda tensor: tensor[index], len(index))


def transform_training_inputs(model: Any) -> None:
    """Ask the physics about the training inputs again, by its parameters of each sample."""
    if model.has_unknowns:
        with torch.no_grad():
            inputs = model.transform_inputs(model._original_train_inputs)
        model.train_inputs = (inputs.clone(),)


def match_parameters(model: Any) -> None:
    """Give samples of the physics' parameters a dimension for outputs, if there are several."""
    if model.has_unknowns:
        coordinates = model.input_transform.coordinates
        if coordinates.dim() > 1:
            shape = (len(coordinates), *[1] * (model.num_outputs > 1), coordinates.shape[-1])
            _set_coordinates(model, coordinates.reshape(shape))


def _set_coordinates(model: Any, coordinates: Tensor) -> None:
    """Give the parameters of the physics a batch, ``(S) x (1) x p``: the 1 is for the outputs."""
    model.input_transform.coordinates = Parameter(coordinates.detach(), requires_grad=False)


@torch.no_grad()
def _change(model: Any, change: Callable[[Tensor], Tensor], num_samples: int | None) -> None:
    """Change the leading dimensions of all that a model has for each of its batches."""
    outputs = model._aug_batch_shape

    def changed(shape: Size) -> Size:
        return change(torch.empty(shape, device="meta")).shape

    model.eval()
    for module in (*model.covar_module.modules(), *model.likelihood.modules()):
        if isinstance(module, Kernel) and module._batch_shape[: len(outputs)] == outputs:
            module._batch_shape = changed(module._batch_shape)
        if isinstance(module, FixedGaussianNoise) and model.num_samples is not None:
            noise, of_each = module.noise, (*outputs, module.noise.shape[-1])
            # Samples share the noise of the training data, but not that of later observations.
            shared = num_samples is not None and noise.dim() < len(of_each)
            module.noise = noise if shared else change(noise.expand(of_each))
        for name, buffer in [*module.named_buffers(recurse=False)] * isinstance(module, _BATCHED):
            if name != "active_dims":  # GPyTorch's, which has no batch
                setattr(module, name, change(buffer))
        for name, parameter in [*module.named_parameters(recurse=False)]:
            if parameter.shape[: len(outputs)] == outputs:
                new = Parameter(change(parameter), requires_grad=parameter.requires_grad)
                setattr(module, name, new)
    if model.has_unknowns:
        _set_coordinates(model, change(model.input_transform.coordinates))
    model.train_inputs = tuple(change(t) for t in model.train_inputs)
    if model._original_train_inputs is not None:
        model._original_train_inputs = change(model._original_train_inputs)
    model.train_targets = change(model.train_targets)
    model._input_batch_shape = changed(model._input_batch_shape)
    model._aug_batch_shape = changed(outputs)
    model.prediction_strategy, model.num_samples = None, num_samples
    model._is_fully_bayesian = model._is_ensemble = num_samples is not None
