"""Fitting a model of more data from the hyper-parameters of the one before it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from gpadjust.inference import fit as fit_model
from gpadjust.inference.warm_start import warm_start
from gpadjust.models import TermsGP


def refit(model: Any, previous: Any, fit: Callable[[Any], Any] | None) -> None:
    """Fit a model, in place, from where an earlier point fit of the same structure was.

    Args:
        model: The model.
        previous: The model fitted last, or None.
        fit: Fits it. Default: :func:`gpadjust.fit`.
    """
    if previous is not None and _alike(model, previous):
        warm_start(model, previous)
    (fit or fit_model)(model)


def parameter_values(model: Any) -> dict[str, Any]:
    """All parameters of a model as lists; none of one that no fit can begin from."""
    if not isinstance(model, TermsGP) or model.num_samples is not None:
        return {}
    return {name: parameter.tolist() for name, parameter in model.named_parameters()}


def load_parameter_values(model: Any, values: dict[str, Any]) -> bool:
    """Give a model parameters, unless it has others; tell whether it was done."""
    if not isinstance(model, TermsGP):
        return False
    named = dict(model.named_parameters())
    try:
        tensors = {name: torch.tensor(v, dtype=torch.float64) for name, v in values.items()}
    except (AttributeError, TypeError, ValueError):  # a log may have been edited
        return False
    if _shapes(named) != _shapes(tensors):
        return False
    with torch.no_grad():
        for name, parameter in named.items():
            parameter.copy_(tensors[name])
    model.eval()
    return True


def _alike(model: Any, previous: Any) -> bool:
    """True if a warm start of one model from another makes sense."""
    if type(model) is not type(previous) or not isinstance(model, TermsGP):
        return False
    if model.num_samples is not None or previous.num_samples is not None:
        return False
    learnt = [
        {name: p for name, p in each.named_parameters() if p.requires_grad}
        for each in (model, previous)
    ]
    return _shapes(learnt[0]) == _shapes(learnt[1])


def _shapes(tensors: Mapping[str, Tensor]) -> dict[str, torch.Size]:
    return {name: tensor.shape for name, tensor in tensors.items()}
