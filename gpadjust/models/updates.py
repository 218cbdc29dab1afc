"""Observations that a model takes one after the other, at a constant cost."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Size, Tensor
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
        if model.link is not None:
            Y, noise = model.link(Y, noise)
        lead, inputs = model.train_targets.shape[:-1], model.model_inputs(X)
        targets = (model.outputs_first(Y) - shift) / scale
        if noise is not None:
            noise = model.outputs_first(noise) / scale.square()
            noise = noise.expand(*lead, len(X)).nan_to_num(nan=1.0, posinf=1.0)
        inputs = inputs.expand(*lead, *inputs.shape[-2:])
        return cls(X, inputs, targets.expand(*lead, len(X)), noise)


@torch.no_grad()
def judge(model: Any, new: NewRows, forget: float) -> None:
    """Let variances follow the errors of what a model predicted of new rows."""
    f, errors = model.at(new.inputs), model.local_errors
    mean, variance = model.conditioning().marginals(f)
    variance = variance + (model.noise.at(f.x) if new.noise is None else new.noise)
    x, missed = f.x[..., : model.terms[0].num_inputs], new.targets - mean
    if model.num_samples is not None:
        variance = variance.mean(0) + mean.var(0, correction=0)
        missed, x = missed.mean(0), x[0]
    errors.observe(missed.square() / (variance * errors(x, recent=False)), forget)


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
    rows = model.noise.rows
    if rows is not None:
        rows.errors = last(rows.errors, torch.zeros_like(new.targets), -1)
        rows.added = last(rows.added, torch.zeros_like(new.targets), -1)
    if new.noise is not None:
        holder = model.likelihood.noise_covar
        holder.noise = last(holder.noise.expand(*new.noise.shape[:-1], -1), new.noise, -1)
    model.prediction_strategy = None


class UpdatedWeights(Module):
    r"""What observations say of the weights of features, without the observations.

    In units of the weights' prior, N(0, I), it is their precision :math:`\Lambda`, and h of the
    mean :math:`\Lambda^{-1} h`. An observation :math:`y = \varphi^T \beta + \epsilon` adds to
    both; before, with :math:`\lambda = e^{-1 / \tau}`, what was observed fades, the prior does not
    (stabilised forgetting, Kulhavy and Zarrop 1993):

    .. math:: \Lambda \leftarrow \lambda \Lambda + (1 - \lambda) I + \varphi \varphi^T /
        \sigma^2, \quad h \leftarrow \lambda h + \varphi y / \sigma^2.

    It is a Kalman filter in its information form. An observation of :math:`k` steps ago counts as
    one with the noise :math:`\sigma^2 e^{k / \tau}`; no variance grows beyond the prior's.

    Args:
        precision: ``batch_shape x (m) x p x p``.
        pull: h, ``batch_shape x (m) x p``.
        rows: Number of the model's own observations in these, ``batch_shape x (m)``.
    """

    precision: Tensor
    pull: Tensor
    rows: Tensor

    def __init__(self, precision: Tensor, pull: Tensor, rows: Tensor) -> None:
        super().__init__()
        self.register_buffer("precision", precision)
        self.register_buffer("pull", pull)
        self.register_buffer("rows", rows)

    @classmethod
    def of_prior(cls, shape: Size, num_rows: int, like: Tensor) -> UpdatedWeights:
        """Before any observation, of ``batch_shape x (m) x p`` weights."""
        rows = torch.full(shape[:-1], num_rows, device=like.device)
        one = torch.eye(shape[-1]).to(like).expand(*shape, -1)
        return cls(one.clone(), like.new_zeros(shape), rows)

    @torch.no_grad()
    def observe(self, design: Tensor, residual: Tensor, noise: Tensor, forget: float) -> None:
        r"""Take observations, the last of which is the newest.

        Args:
            design: Their features, ``... x k x p``.
            residual: Targets less their prior mean, ``... x k``; NaN where one is missing.
            noise: Noise variances, ``... x k``.
            forget: :math:`\tau`; infinite for never.
        """
        k = residual.shape[-1]
        left = torch.arange(k - 1, -1, -1).to(noise).div(-forget).exp()
        weight = (left / noise).masked_fill(residual.isnan(), 0.0)
        kept = math.exp(-k / forget)
        weighted = (design * weight.unsqueeze(-1)).mT
        # Not in place: others may read what was before.
        precision = kept * self.precision + weighted @ design
        precision.diagonal(dim1=-1, dim2=-2).add_(1 - kept)
        self.precision = precision
        pull = (weighted @ residual.nan_to_num(nan=0.0).unsqueeze(-1)).squeeze(-1)
        self.pull = kept * self.pull + pull

    def moments(self) -> tuple[Tensor, Tensor, int]:
        """The mean, a root of the covariance, and the number of the model's own rows."""
        chol, _ = cholesky(self.precision.clone())
        identity = torch.eye(chol.shape[-1]).to(chol).expand_as(chol)
        root = torch.linalg.solve_triangular(chol, identity, upper=False).mT
        mean = root @ (root.mT @ self.pull.unsqueeze(-1))
        return mean.squeeze(-1), root, int(self.rows.max())
