"""Fit a model: draw its unknown numbers given the data, or bring them to their most likely values."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gpadjust.core.sample import GROUPS, Draws, around_mode, maximise, sample

if TYPE_CHECKING:
    from gpadjust.core.model import GP

_SMALL, _MEDIUM = 40, 150  # points: up to these draws begin with the prior, and are moved
_ENTRIES = 4_000_000  # of covariances that are computed at once
_SELDOM = 1e-3  # a nested model of less probability at its mode is not drawn from
_MOVED = 0.35  # predicted standard deviations by which another seed may move the mean


@dataclass(frozen=True)
class FitResult:
    """What :func:`fit` has found; its text is what to read first.

    Args:
        method: ``"bayes"`` or ``"map"``.
        log_evidence: The log probability of the targets of each output, ``m``, in their units (of
            outputs that share unknown numbers, of all together); None of a point fit.
        probabilities: The probability of each nested model by its text, for each output; empty if
            there is one model only.
        effective: The least number of starting draws that count, of all outputs.
        error: By how many predicted standard deviations another seed would move the mean at a
            training input that is left out, root mean square; NaN of a point fit.
        num_draws: How many draws predictions average over.
    """

    method: str
    log_evidence: Tensor | None
    probabilities: dict[str, list[float]]
    effective: float
    error: float
    num_draws: int

    @property
    def converged(self) -> bool:
        """Whether predictions hardly depend on the seed."""
        return not self.error > _MOVED

    def __str__(self) -> str:
        lines = []
        outputs = max((len(shares) for shares in self.probabilities.values()), default=0)
        for j in range(outputs):
            shares = [f"{text} {p[j]:.2f}" for text, p in self.probabilities.items()]
            which = f" (output {j + 1})" if outputs > 1 else ""
            lines.append(f"Probabilities{which}: {', '.join(shares)}.")
        if self.method == "map":
            lines.append("Point fit: intervals ignore what is unknown of the hyper-parameters.")
        else:
            lines.append(
                f"{self.num_draws} draws; another seed would move predictions by {self.error:.2f} "
                "of their standard deviation."
            )
        return "\n".join(lines)


def fit(
    model: GP, method: str = "bayes", *, num_draws: int | None = None, seed: int = 0
) -> FitResult:
    """Fit a model to its data, from the prior: what it held before has no influence.

    ``"bayes"`` draws all unknown numbers from their posterior: by sequential Monte Carlo from the
    prior up to 40 points, from Laplace's approximation beyond; beyond 150 points its draws are
    weighted once and not moved. Nested models are drawn from apart and pooled by their posterior
    probabilities. ``"map"`` brings the numbers of the whole model to their most likely values.

    Args:
        model: The model.
        method: ``"bayes"`` or ``"map"``.
        num_draws: Number of draws, a multiple of 4. Default: 64, 32 or 16, of a physics with
            unknown parameters 256; predictions average over every fourth.
        seed: Seed.

    Warns:
        UserWarning: If another seed would move predictions by much.

    Raises:
        ValueError: If the method is unknown, or the number of draws no positive multiple of 4.

    Example:
        >>> import torch
        >>> from gpadjust.core import ZeroMeanGP, fit
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> fit(ZeroMeanGP(X, X.sin())).converged
        True
    """
    if method not in ("bayes", "map"):
        raise ValueError(f"Unknown method {method!r}; expected 'bayes' or 'map'.")
    if num_draws is not None and (num_draws < 4 or num_draws % 4):
        raise ValueError(f"Expected num_draws as a multiple of 4; found {num_draws}.")
    n, table = len(model.data.Y), model.table
    number = num_draws or _default_number(model)
    target = _Target(model, [0] if method == "map" else [*range(max(1, len(table.choices)))])
    if method == "map":
        model.set_draws(target.mode(seed, searches=3).unsqueeze(0))
        return FitResult(method, None, {}, math.nan, math.nan, 1)
    if n <= _SMALL:
        draws = sample(target, target.like, number, seed)
    else:
        start, evidence = around_mode(target, target.mode(seed))
        kept = target.keep(evidence)
        start = type(start)(start.mean[kept], start.root[kept])
        draws = sample(target, target.like, number, seed, start, 4, n <= _MEDIUM)
    weights = target.weights(draws.log_evidence.logsumexp(0) - math.log(GROUPS))
    u = _pooled(target, draws.u, weights, number)
    model.set_draws(u, max(1, number // 4 if num_draws is None else number))
    if num_draws is None:
        model.set_draws(u, _default_kept(n))
    error = _error(model, target, draws, number)
    result = FitResult(
        method,
        target.evidence(draws),
        {c.text: weights[k].expand(model.num_outputs).tolist() for k, c in enumerate(table.choices)},
        float(draws.effective.min()),
        error,
        len(model.u),
    )
    if not result.converged:
        warnings.warn(
            f"Predictions depend on the seed: another one would move them by {error:.2f} of their "
            f"standard deviation. Draw more: fit(model, num_draws={4 * number}).",
            stacklevel=2,
        )
    return result


def _default_number(model: GP) -> int:
    n = len(model.data.Y)
    if model.table.shared and n <= _MEDIUM:
        return 256
    if n <= _SMALL:
        return 64
    return 32 if n <= _MEDIUM else 16


def _default_kept(n: int) -> int:
    if n <= _SMALL:
        return 16
    return 8 if n <= _MEDIUM else 4


class _Target:
    """The log likelihood of the nested models of a model, as that of K B independent problems."""

    def __init__(self, model: GP, which: list[int]) -> None:
        self.model, self.which, self.table = model, which, model.table
        self.problems = model.table.problems

    @property
    def like(self) -> Tensor:
        """A tensor ``K B x P``."""
        u = self.model.u.detach()
        return u.new_zeros(len(self.which) * self.problems, self.table.size)

    def with_choices(self, u: Tensor) -> Tensor:
        """Return coordinates ``N x K x B x P`` of ``N x (K B) x P``, each of its nested model."""
        u = u.reshape(len(u), len(self.which), self.problems, -1)
        if not self.table.choices:
            return u
        parts = [self.table.with_choice(u[:, i], k) for i, k in enumerate(self.which)]
        return torch.stack(parts, 1)

    def __call__(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return log likelihoods ``N x (K B)``, and their gradients."""
        rows = self.with_choices(u).flatten(0, 1)
        n = len(self.model.data.Y)
        size = max(1, _ENTRIES // (n * n * self.model.num_outputs))
        parts = [self.model.log_likelihood(part) for part in rows.split(size)]
        value, slope = (torch.cat(each) for each in zip(*parts, strict=True))
        return value.reshape(len(u), -1), slope.reshape(u.shape)

    def mode(self, seed: int, searches: int = 1) -> Tensor:
        """Return the most likely coordinates, ``K B x P``, searched from the best of some."""
        n = len(self.model.data.Y)
        number = max(16, 6400 // max(n, 25))
        generator = torch.Generator().manual_seed(seed)
        like = self.like
        u = torch.randn(number, *like.shape, generator=generator, dtype=like.dtype).to(like)
        u[0] = 0.0
        order = self._density(u).argsort(0, descending=True)
        problems = torch.arange(len(like))
        ends = torch.stack([maximise(self, u[order[i], problems]) for i in range(searches)])
        if searches > 1:
            ends = torch.cat([ends, maximise(self, u[0]).unsqueeze(0)])
        best = ends[self._density(ends).argmax(0), problems]
        return self.with_choices(best.unsqueeze(0)).reshape(like.shape)

    def _density(self, u: Tensor) -> Tensor:
        """Return the log posterior density but for a constant, ``N x (K B)``."""
        density = self(u)[0] - 0.5 * u.square().sum(-1)
        return density.nan_to_num(nan=-math.inf)

    def weights(self, log_evidence: Tensor) -> Tensor:
        """Return the posterior probabilities of all nested models, ``K x B``."""
        if not self.table.choices:
            return torch.ones_like(log_evidence).reshape(1, -1)
        prior = log_evidence.new_tensor([c.probability for c in self.table.choices])
        logs = prior.log().unsqueeze(-1).expand(-1, self.problems).clone()
        mine = log_evidence.reshape(len(self.which), -1)
        rest = torch.full_like(logs, -math.inf)
        rest[self.which] = logs[self.which] + mine
        return rest.softmax(0)

    def keep(self, log_evidence: Tensor) -> Tensor:
        """Leave nested models out that are unlikely in all problems; return which rows stay."""
        weights = self.weights(log_evidence)
        is_kept = [bool((weights[k] > _SELDOM).any()) for k in self.which]
        rows = torch.tensor(is_kept).repeat_interleave(self.problems)
        self.which = [k for k, stays in zip(self.which, is_kept, strict=True) if stays]
        return rows

    def evidence(self, draws: Draws) -> Tensor:
        """Return the log evidence of each problem, in the user's units."""
        logs = draws.log_evidence.logsumexp(0) - math.log(GROUPS)
        logs = logs.reshape(len(self.which), -1)
        if self.table.choices:
            prior = logs.new_tensor([self.table.choices[k].probability for k in self.which])
            logs = logs + prior.log().unsqueeze(-1)
        counts = (~self.model.data.Y.isnan()).sum(0)
        units = counts * self.model.unit.squeeze(-1).log()
        return logs.logsumexp(0) - (units if self.problems > 1 else units.sum())


def _pooled(target: _Target, u: Tensor, weights: Tensor, number: int) -> Tensor:
    """Return ``number x B x P`` draws of all nested models in proportion to their weights."""
    u = target.with_choices(u)  # N x K x B x P
    outputs = []
    for b in range(target.problems):
        shares = weights[:, b] if target.table.choices else weights.new_ones(1)
        rows = []
        for k, count in enumerate(_counts(shares, number)):
            if count:
                i = target.which.index(k)
                at = (torch.arange(count) + 0.5) * len(u) / count
                rows.append(u[at.long(), i, b])
        outputs.append(torch.cat(rows))
    return torch.stack(outputs, 1)


def _counts(shares: Tensor, number: int) -> list[int]:
    """Return whole numbers in proportion to shares, of a given sum, by largest remainders."""
    exact = shares * number
    counts = exact.floor()
    order = (counts - exact).argsort()
    counts[order[: number - int(counts.sum())]] += 1
    return [int(count) for count in counts]


def _error(model: GP, target: _Target, draws: Draws, number: int) -> float:
    """Return how far another seed would move the mean, in predicted standard deviations.

    The draws are two groups that were resampled apart; with the weights of nested models by each of
    them they predict the left-out targets. The difference of two means of N / 2 draws has a
    standard deviation twice that of one of N.
    """
    means = []
    halves = draws.u.chunk(GROUPS)
    for half, evidence in zip(halves, draws.log_evidence, strict=True):
        u = _pooled(target, half, target.weights(evidence), number // GROUPS)
        means.append(model.left_out_at(u))
    mean, variance = (torch.cat(each) for each in zip(*means, strict=True))
    sd = (variance.mean(0) + mean.var(0, correction=0)).sqrt()
    difference = (means[0][0].mean(0) - means[1][0].mean(0)) / 2
    return float((difference / sd).square().nanmean().sqrt())
