"""Proposals of hyper-parameters: the prior, and the optima of the posterior."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.inference.annealing import Proposal
from gpadjust.inference.optimise import Search, optima
from gpadjust.inference.targets import LogPosterior

_DEGREES = 5  # of freedom: tails that are wider than those of what is sampled, as a rule
_STEP = 0.1  # of differences, in logarithms
_WIDEST = 4.0  # standard deviation of Laplace's approximation, in logarithms
_MODES = 6  # optima that draws begin around, at most
_APART = 0.5  # by which these differ in some logarithm
_EACH = 0.1  # of the draws that all of them share
_ITERATIONS = 30  # of the search, as the draws go on from where it got


class Normal(NamedTuple):
    """Independent normal distributions.

    Attributes:
        mean: ``B x p``.
        sd: ``B x p``.
    """

    mean: Tensor
    sd: Tensor

    def sample(self, number: int, generator: torch.Generator) -> Tensor:
        """Draw ``number x B x p``."""
        shape = (number, *self.mean.shape)
        normal = torch.randn(shape, generator=generator, dtype=self.mean.dtype).to(self.mean)
        return self.mean + self.sd * normal

    def value_and_gradient(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """The negative log density at ``N x B x p``, ``N x B``, and its gradient."""
        white = (positions - self.mean) / self.sd
        constant = (self.sd.log() + 0.5 * math.log(2 * math.pi)).sum(-1)
        return constant + 0.5 * white.square().sum(-1), white / self.sd

    def covariance(self) -> Tensor:
        """Return the covariance of each problem, ``B x p x p``."""
        return torch.diag_embed(self.sd.square())


class Mixture(NamedTuple):
    """Mixtures of Student's t distributions, to draw from.

    Attributes:
        centers: ``k x B x p``.
        weights: ``k x B``, which sum to one.
        root: Roots of their shapes, lower triangular, ``k x B x p x p``.
    """

    centers: Tensor
    weights: Tensor
    root: Tensor

    def sample(self, number: int, generator: torch.Generator) -> Tensor:
        """Draw ``number x B x p``, of which the first is the first center."""
        problems, p = self.centers.shape[1:]
        which = torch.multinomial(
            self.weights.mT.cpu(), number, replacement=True, generator=generator
        ).mT.to(self.centers.device)
        shape = (number, problems, p + _DEGREES)
        normal = torch.randn(shape, generator=generator, dtype=self.root.dtype).to(self.root)
        white = normal[..., :p] / normal[..., p:].square().mean(-1, keepdim=True).sqrt()
        every = torch.arange(problems, device=which.device)
        away = self.root[which, every] @ white.unsqueeze(-1)
        found = self.centers[which, every] + away.squeeze(-1)
        found[0] = self.centers[0]
        return found

    def covariance(self) -> Tensor:
        """Return the covariance of the shape of the first, ``B x p x p``."""
        return self.root[0] @ self.root[0].mT

    def value_and_gradient(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """The negative log density at ``N x B x p``, ``N x B``, and its gradient."""
        p = positions.shape[-1]
        away = positions.unsqueeze(1) - self.centers  # N x k x B x p
        white = torch.linalg.solve_triangular(self.root, away.unsqueeze(-1), upper=False)
        square = white.square().sum((-1, -2))
        log_size = self.root.diagonal(dim1=-1, dim2=-2).abs().log().sum(-1)
        log_part = self.weights.log() - log_size
        log_part = log_part - 0.5 * (_DEGREES + p) * torch.log1p(square / _DEGREES)
        pull = log_part.softmax(1) * (_DEGREES + p) / (_DEGREES + square)
        back = torch.linalg.solve_triangular(self.root.mT, white, upper=True).squeeze(-1)
        at_center = math.lgamma((_DEGREES + p) / 2) - math.lgamma(_DEGREES / 2)
        at_center -= 0.5 * p * math.log(_DEGREES * math.pi)
        return -log_part.logsumexp(1) - at_center, (pull.unsqueeze(-1) * back).sum(1)


class Both(NamedTuple):
    """Mixtures of two proposals, half of each.

    Attributes:
        first: One of them, of whose covariance the mixture is taken to be.
        second: The other.
    """

    first: Proposal
    second: Proposal

    def sample(self, number: int, generator: torch.Generator) -> Tensor:
        """Draw ``number x B x p``."""
        half = number // 2
        parts = (self.first.sample(number - half, generator), self.second.sample(half, generator))
        order = torch.randperm(number, generator=generator).to(parts[0].device)
        return torch.cat(parts)[order]

    def value_and_gradient(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """The negative log density at ``N x B x p``, ``N x B``, and its gradient."""
        parts = [each.value_and_gradient(positions) for each in self]
        values, gradients = (torch.stack(each) for each in zip(*parts, strict=True))
        share = (-values).softmax(0).unsqueeze(-1)
        return math.log(2) - (-values).logsumexp(0), (share * gradients).sum(0)

    def covariance(self) -> Tensor:
        """Return the covariance of the first, ``B x p x p``."""
        return self.first.covariance()


def around_optima(
    target: LogPosterior, search: Search, starts: tuple[int, int]
) -> tuple[Mixture, Tensor]:
    """Laplace's approximation around all optima that the search finds, with wider tails.

    And the log evidence by it, ``B``.
    """
    number, screened = starts
    search = search._replace(
        num_starts=search.num_starts or number,
        num_screened=screened if search.num_screened is None else search.num_screened,
        max_iterations=min(search.max_iterations, _ITERATIONS),
    )
    centers, values = optima(target, search)
    values, order = values.to(centers).sort(dim=0)
    centers = centers.gather(0, order.unsqueeze(-1).expand_as(centers))
    near = (centers.unsqueeze(1) - centers).abs().amax(-1) < _APART  # k x k x B
    again = torch.stack([row[:i].any(0) for i, row in enumerate(near)])  # k x B
    first = again.to(centers).argsort(dim=0, stable=True)[:_MODES]
    centers = centers.gather(0, first.unsqueeze(-1).expand(-1, -1, centers.shape[-1]))
    values, again = values.gather(0, first), again.gather(0, first)
    root = laplace_root(target, centers)
    log_share = root.diagonal(dim1=-1, dim2=-2).abs().log().sum(-1) - values
    log_share = log_share.masked_fill(again, -math.inf)
    even = ~again / (~again).sum(0)
    log_evidence = log_share.logsumexp(0) + 0.5 * centers.shape[-1] * math.log(2 * math.pi)
    weights = (1 - _EACH) * log_share.softmax(0) + _EACH * even
    return Mixture(centers, weights, root), log_evidence


def laplace_root(target: LogPosterior, optima: Tensor) -> Tensor:
    """Roots of the covariances of Laplace's approximation at optima ``k x B x p``.

    Lower triangular, ``k x B x p x p``.
    """
    k, _, p = optima.shape
    step = _STEP * torch.eye(p).to(optima)[:, None, None]
    points = torch.cat([optima + step, optima - step]).flatten(0, 1)
    _, gradient = target.value_and_gradient(points)
    up, down = gradient.unflatten(0, (2 * p, k)).chunk(2)
    hessian = (up - down).movedim(0, -2) / (2 * _STEP)
    values, vectors = torch.linalg.eigh(0.5 * (hessian + hessian.mT))
    root = vectors * values.clamp_min(_WIDEST**-2).rsqrt().unsqueeze(-2)
    return torch.linalg.qr(root.mT).R.mT
