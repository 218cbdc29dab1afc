"""Terms of other machines, as the prior of those of this one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import Module, Parameter

from gpadjust.gp.gaussian import cholesky
from gpadjust.gp.kernels import Batched, Profile, Stationary
from gpadjust.gp.term import Unit, side_by_side

_NAMES = ("points", "lengthscale", "variance", "mean", "root", "scale")
_NUGGET = 1e-6  # of a variance: functions of other kernels are interpolated, too


class Sister(Batched, Module):
    r"""Posterior of other machines, as a sum of terms beside that of this machine's own terms.

    A term is then :math:`g_t = s_t + o_t`: what others taught, and the machine's own difference
    with the kernel of the model. Of the functions s, in the user's units, the values at points Z
    have a joint normal distribution, and between these they are Gaussian processes of the others'
    kernels,

    .. math:: s_t(x) = A_t(x) s_t(Z) + r_t(x), \quad A_t(x) = k_t(x, Z) k_t(Z, Z)^{-1},

    with the covariance :math:`k_t(x, x') - A_t(x) k_t(Z, x')` of the rest r.

    Args:
        points: Z, ``batch_shape x (m) x M x d``, as the kernels read them.
        lengthscale: Those of the kernels, ``batch_shape x (m) x T x d``.
        variance: Likewise, ``batch_shape x (m) x T``.
        mean: Means less those of this model's prior, ``batch_shape x (m) x T M``, term by term.
        root: A root of the covariance, ``batch_shape x (m) x T M x T M``.
        scale: Unit of the model's targets, ``batch_shape x (m) x 1``.

    Attributes:
        on: 1, or 0 for a sample that does without, ``batch_shape x (m) x 1``.
    """

    points: Tensor
    lengthscale: Tensor
    variance: Tensor
    mean: Tensor
    root: Tensor
    scale: Tensor

    def __init__(self, **tensors: Tensor) -> None:
        super().__init__()
        for name in _NAMES:
            self.register_buffer(name, tensors[name])
        self.on = Parameter(torch.ones_like(self.scale), requires_grad=False)

    @classmethod
    def of_state(cls, state: Mapping[str, Tensor], batch_dims: int) -> Sister | None:
        """Return that of a model's ``state_dict``, of the first of its samples; None without."""
        own = {name: state.get(f"covar_module.sister.{name}") for name in _NAMES}
        found = {name: tensor for name, tensor in own.items() if tensor is not None}
        if len(found) < len(own):
            return None
        if found["scale"].dim() > batch_dims + 1:
            found = {name: tensor[0] for name, tensor in found.items()}
        return cls(**{name: tensor.clone() for name, tensor in found.items()})

    def forms(self, profiles: Sequence[Profile]) -> list[Stationary]:
        """The kernels, of profiles that the model's own have, at variances in the user's units."""
        lengths, sizes = self.lengthscale.unbind(-2), self.variance.unbind(-1)
        parts = zip(lengths, sizes, profiles, strict=True)
        return [Stationary(length.unsqueeze(-2), size, profile) for length, size, profile in parts]

    def at(self, x: Tensor, parts: Any, terms: Any) -> SisterSum:
        """Their contribution to a weighted sum of a model's terms."""
        return SisterSum(self, x, parts, terms)


class SisterSum:
    """What other machines taught of a weighted sum of terms at inputs ``x``.

    A bias that a center was taken from stands for ``delta + c rho``, so that the weight of a rho in
    the user's meaning is its own and c times that of the bias.
    """

    def __init__(self, sister: Sister, x: Tensor, parts: Any, terms: Any) -> None:
        own = [term for term in terms if term.kernel is not None]
        given = {term.name: weight for term, weight in parts}
        one = torch.ones_like(x[..., 0])
        of = {t.name: one if given[t.name] is None else given[t.name] for t, _ in parts}
        bias = [of[t.name] for t in terms if t.unit is Unit.TARGET and t.name in of]
        self.sister, self.x = sister, x[..., : terms[0].num_inputs]
        self.forms = sister.forms([term.form.profile for term in own])
        self.weights = []
        for term in own:
            weight = of.get(term.name, torch.zeros_like(one))
            if term.unit is Unit.TARGET:
                weight = weight / sister.scale
            elif bias and hasattr(term.basis, "origin"):
                weight = weight + bias[0] * term.basis.origin / sister.scale
            self.weights.append(weight * sister.on)

    def _along(self) -> tuple[list[Tensor], Tensor]:
        """Covariances with the points, and the weights of their values, ``... x n x T M``."""
        near, each = [], []
        for form, weight in zip(self.forms, self.weights, strict=True):
            points = self.sister.points
            among = form.covariance(points)
            among = among + _NUGGET * torch.diag_embed(among.diagonal(dim1=-1, dim2=-2))
            chol, _ = cholesky(among)
            near.append(form.covariance(self.x, points))
            solved = torch.cholesky_solve(near[-1].mT, chol).mT
            each.append(solved * weight.unsqueeze(-1))
        return near, torch.cat(torch.broadcast_tensors(*each), dim=-1)

    def mean(self) -> Tensor:
        """The mean, ``... x n``."""
        return (self._along()[1] @ self.sister.mean.unsqueeze(-1)).squeeze(-1)

    def features(self, maps: Sequence[Module]) -> Tensor:
        """Random features, ``... x n x D``, of maps of the kernels: of the values, and the rest."""
        _, along = self._along()
        found = [along @ self.sister.root]
        size = self.sister.points.shape[-2]
        for i, (each, weight) in enumerate(zip(maps, self.weights, strict=True)):
            solved = along[..., i * size : (i + 1) * size]
            own = each(self.x) * weight.unsqueeze(-1)
            found.append(own - solved @ each(self.sister.points))
        return side_by_side(found)

    def covariance(self, other: SisterSum, diagonal: bool = False) -> Tensor:
        """The covariance with another sum, ``... x n x n'``; or the diagonal ``... x n``."""
        near, along = self._along()
        theirs, beyond = (near, along) if other is self else other._along()
        left, right = along @ self.sister.root, beyond @ self.sister.root
        size = self.sister.points.shape[-2]
        total = (left * right).sum(-1) if diagonal else left @ right.mT
        parts = zip(self.forms, self.weights, other.weights, theirs, strict=True)
        for i, (form, w, v, k) in enumerate(parts):
            # The weight is in `along` already.
            solved = along[..., i * size : (i + 1) * size]
            if diagonal:
                rest = form.diagonal(self.x) * w - (solved * k).sum(-1)
                total = total + (rest * v).where(rest * v > 0, 0.0)
            else:
                prior = form.covariance(self.x, None if other is self else other.x)
                total = total + (prior * w.unsqueeze(-1) - solved @ k.mT) * v.unsqueeze(-2)
        return total
