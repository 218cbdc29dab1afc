"""Observations that a model takes one after the other, at a constant cost."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import Module

from gpadjust.gp.gaussian import cholesky


class NewRows(NamedTuple):
    """New observations of a model, in its own form and units.

    Attributes:
        raw: Inputs as the user gave them, ``k x d``.
        inputs: Transformed, ``... x (S) x (m) x k x (d + k')``.
        targets: ``... x (S) x (m) x k``; NaN where one is missing.
        noise: Their known variances, of the same shape, or None where the model learns them.
    """

    raw: Tensor
    inputs: Tensor
    targets: Tensor
    noise: Tensor | None

    @classmethod
    def of(cls, model: Any, X: Tensor, Y: Tensor, noise: Tensor | None) -> NewRows:
        """Rows of checked tensors ``k x d`` and ``k x m``; ``noise`` is in the user's units."""
        shift, scale = model.units()
        lead, inputs = model.train_targets.shape[:-1], model.model_inputs(X)
        targets = (model.outputs_first(Y) - shift) / scale
        if noise is not None:
            noise = model.outputs_first(noise) / scale.square()
            noise = noise.expand(*lead, len(X)).nan_to_num(nan=1.0, posinf=1.0)
        inputs = inputs.expand(*lead, *inputs.shape[-2:])
        return cls(X, inputs, targets.expand(*lead, len(X)), noise)


@torch.no_grad()
def keep_last(model: Any, new: NewRows, number: int) -> None:
    """Give an exact model new rows, and drop all but the last ones of it."""

    def last(old: Tensor, more: Tensor, dim: int) -> Tensor:
        joined = torch.cat([old, more], dim=dim)
        return joined.narrow(
            dim, max(0, joined.shape[dim] - number), min(number, joined.shape[dim])
        )

    original = model._original_train_inputs
    if original is not None:
        raw = new.raw.expand(*original.shape[:-2], *new.raw.shape)
        model._original_train_inputs = last(original, raw, -2)
    model.train_inputs = (last(model.train_inputs[0], new.inputs, -2),)
    model.train_targets = last(model.train_targets, new.targets, -1)
    if new.noise is not None:
        holder = model.likelihood.noise_covar
        holder.noise = last(holder.noise.expand(*new.noise.shape[:-1], -1), new.noise, -1)
    model.prediction_strategy = None


class UpdatedWeights(Module):
    r"""The posterior of the weights of features, after observations that are not kept.

    In units of the weights' prior, N(0, I). An observation :math:`y = \varphi^T \beta + \epsilon`
    is a step of a Kalman filter, :math:`g = P \varphi`, :math:`s = \varphi^T g + \sigma^2`,

    .. math:: \mu \leftarrow \mu + g (y - \varphi^T \mu) / s, \quad P \leftarrow P - g g^T / s,

    before which the weights of functions wander, with :math:`a = e^{-1 / \tau}`,

    .. math:: \mu \leftarrow a \mu, \quad P \leftarrow a^2 P + (1 - a^2) I,

    which is stationary with their prior: where no data come, they return to it in some
    :math:`\tau` observations, and no variance grows beyond it.

    Args:
        mean: ``batch_shape x (m) x p``.
        covariance: P, ``batch_shape x (m) x p x p``.
        rows: Number of the model's own observations in these, ``batch_shape x (m)``.
    """

    mean: Tensor
    covariance: Tensor
    rows: Tensor

    def __init__(self, mean: Tensor, covariance: Tensor, rows: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("covariance", covariance)
        self.register_buffer("rows", rows)

    @torch.no_grad()
    def observe(self, design: Tensor, residual: Tensor, noise: Tensor, kept: Tensor | None) -> None:
        """Take observations one after the other.

        Args:
            design: Their features, ``... x k x p``.
            residual: Targets less their prior mean, ``... x k``; NaN where one is missing.
            noise: Noise variances, ``... x k``.
            kept: The share a of each weight, ``p``; None if they do not wander.
        """
        mean, P = self.mean, self.covariance  # not in place: others may read what was before
        for i in range(residual.shape[-1]):
            if kept is not None:
                mean = kept * mean
                P = P * kept * kept.unsqueeze(-1) + torch.diag(1 - kept.square())
            phi, r = design[..., i, :].expand_as(mean), residual[..., i]
            gain = (P @ phi.unsqueeze(-1)).squeeze(-1)
            variance = (phi * gain).sum(-1) + noise[..., i]
            missed = (r - (phi * mean).sum(-1)).nan_to_num(nan=0.0)
            share = (~r.isnan()).to(P) / variance
            mean = mean + gain * (share * missed).unsqueeze(-1)
            P = P - gain.unsqueeze(-1) * (share.unsqueeze(-1) * gain).unsqueeze(-2)
        self.mean, self.covariance = mean, P

    def moments(self) -> tuple[Tensor, Tensor, int]:
        """The mean, a lower root of the covariance, and the number of the model's own rows."""
        root, _ = cholesky(self.covariance.clone())
        return self.mean, root, int(self.rows.max())
