"""Noise that grows with the size of what is measured."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gpadjust.gp.kernels import RBF, Stationary
from gpadjust.gp.noise import RowNoise, RowSource
from gpadjust.models.component_noise import ComponentNoise

_FLOOR = 1e-3  # of the largest size, that a size is at least
_NEAR = 0.5  # of the shortest lengthscale, within which sizes are alike
_FAR = 1e-6  # weight of the mean of all sizes, which counts far from all points
_STILL = 0.2  # change of the logarithm of a size that needs no other fit
_ROUNDS = 4


class RelativeNoise(ComponentNoise):
    r"""Noise of the variance :math:`s_0 + s_1 g(x)^2`, both numbers learnt.

    The size g is that of the physics (of several, of their sum with the prior means of the rhos),
    over its root mean square at the training inputs. Of a model without physics it is that of the
    posterior mean by rough fits: at the training inputs, and between them by a weighted mean of
    its logarithms, with an RBF kernel of half the shortest lengthscale.

    Args:
        make: The builder of the model's terms.

    Attributes:
        weights: Of all columns of physics in g, ``batch_shape x (m) x 1 x k``.
        size: The root mean square, in the user's units, ``batch_shape x (m) x 1``.
        points: The training inputs, ``batch_shape x (m) x n x d``.
        log_sizes: Logarithms of g there, ``batch_shape x (m) x n``, if there is no physics.
        lengthscale: Of the RBF kernel, ``batch_shape x (m) x 1 x d``.
    """

    weights: Tensor
    size: Tensor
    points: Tensor
    log_sizes: Tensor
    lengthscale: Tensor

    def __init__(self, make: Any) -> None:
        super().__init__(2, make.batch_shape)
        Y, batch = make.data.Y, make.batch_shape
        f_p = make.prior_mean() if make.f else Y.nan_to_num(nan=0.0)
        size = f_p.square().mean(-2, keepdim=True).sqrt()  # batch_shape x 1 x m
        size = size.where(size > 0, torch.ones_like(size))
        m, points = Y.shape[-1], make.columns()
        columns = [
            torch.diag_embed((mean / size).expand_as(size).squeeze(-2)) for mean in make.means
        ]
        weights = (
            torch.cat(columns, dim=-1) if columns else points.new_zeros(*size.shape[:-2], m, 0)
        )
        points = points.unsqueeze(-3).expand(*batch, *points.shape[-2:]) if m > 1 else points
        every = {
            "weights": weights.unsqueeze(-2) if m > 1 else weights,
            "size": size.mT if m > 1 else size.squeeze(-1),
            "points": points.clone(),
            "log_sizes": torch.zeros_like(points[..., 0]),
            "lengthscale": torch.ones_like(points[..., :1, :]),
        }
        for name, value in every.items():
            self.register_buffer(name, value)

    def selection(self, inputs: Tensor) -> Tensor:
        """The shares 1 and :math:`g^2` at ``... x n x (d + k)``, ``... x n x 2``."""
        k = self.weights.shape[-1]
        if k:
            squares = (inputs[..., -k:] * self.weights).sum(-1).square()
        else:
            kernel = Stationary(self.lengthscale, inputs.new_ones(()), RBF)
            near = kernel.covariance(inputs[..., : self.points.shape[-1]], self.points)
            known = (near @ self.log_sizes.unsqueeze(-1)).squeeze(-1)
            mean = self.log_sizes.mean(-1, keepdim=True)
            squares = (2 * (known + _FAR * mean) / (near.sum(-1) + _FAR)).exp()
        return torch.stack([torch.ones_like(squares), squares], dim=-1)

    def said(self, scale: Tensor) -> list[Tensor]:
        """The constant standard deviation in the user's units, of a scale; and the relative one."""
        constant, relative = self.noise.sqrt().unbind(-1)
        return [constant * scale, relative * scale / self.size.squeeze(-1)]


class MeanSizes(RowSource):
    """Sizes of a :class:`RelativeNoise` without physics, by the posterior means of rough fits."""

    def __init__(self) -> None:
        self._rounds = 0

    @torch.no_grad()
    def refine(self, model: Any, rows: RowNoise) -> bool:
        """Take the sizes of the model's posterior mean."""
        noise, (shift, scale) = model.likelihood, model.units()
        train = model.train_inputs[0]
        mean = model.conditioning().marginals(model.at(train))[0] * scale + shift
        forms = [term.form for term in model.terms if isinstance(term.form, Stationary)]
        lengths = [form.lengthscale.expand_as(noise.lengthscale) for form in forms]
        if lengths:
            noise.lengthscale = _NEAR * torch.stack(lengths).amin(0)
        size = mean.abs().maximum(_FLOOR * mean.abs().amax(-1, keepdim=True))
        noise.size = size.square().mean(-1, keepdim=True).sqrt()
        found = (size / noise.size).log()
        change, self._rounds = (found - noise.log_sizes).abs().amax(), self._rounds + 1
        noise.log_sizes = found
        return bool(change > _STILL) and self._rounds < _ROUNDS
