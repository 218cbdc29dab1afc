"""Correlations between the errors of a state's entries, as far as data show them."""

from __future__ import annotations

import torch
from botorch.models.model import Model
from torch import Tensor

from gpadjust.core import GP

_CLEAR = 3.5  # standard errors, below which a correlation counts as none
_LEAST = 1e-6  # eigenvalue of a correlation matrix


def error_correlation(model: Model) -> Tensor | None:
    r"""The correlation of outputs by a model's left-out errors, ``m x m``; None if none is clear.

    A correlation r of n pairs has the standard error :math:`(1 - r^2) / \sqrt n`. It counts where
    :math:`|r| \sqrt n` is more than 3.5, and is shrunk by the share of its square that is chance
    (Schaefer and Strimmer 2005).
    """
    if model.num_outputs < 2 or not isinstance(model, GP):
        return None
    errors = model.data.Y - model.left_out().prediction.mean
    seen = ~errors.isnan()
    errors, seen = errors.nan_to_num(nan=0.0), seen.double()
    number = (seen.mT @ seen).clamp_min(1.0)
    size = (errors.square().mT @ seen).clamp_min(torch.finfo(errors.dtype).tiny)
    r = (errors.mT @ errors) / (size * size.mT).sqrt()
    clear = r.abs() * number.sqrt() > _CLEAR
    chance = (1 - r.square()).square() / (number * r.square().clamp_min(1e-12))
    r = torch.where(clear, r * (1 - chance).clamp_min(0.0), 0.0)
    r.fill_diagonal_(1.0)
    if not (r - torch.eye(len(r))).any():
        return None
    values, vectors = torch.linalg.eigh(r)
    if values[0] < _LEAST:  # pairs that are seen together in other rows than others
        r = vectors * values.clamp_min(_LEAST) @ vectors.mT
        sd = r.diagonal().sqrt()
        r = r / sd / sd.unsqueeze(-1)
    return r
