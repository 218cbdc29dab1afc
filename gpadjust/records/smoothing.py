"""The states that a machine was in, from noisy and incomplete records and a physics."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import progress_bar
from gpadjust.dynamics.particles import even_normal
from gpadjust.physics import PhysicsError
from gpadjust.records.chain import Chain
from gpadjust.records.kalman import Array, Smoothed, smooth_chain

_LONGER = 1.6  # than a step of expectation maximisation, in logarithms
_NEARER = math.log(4)  # the most that a logarithm of a variance changes in a round
_ARRIVED = 0.01  # nats of the log density
_STEADY = 0.05  # a change of the logarithm of a variance
_STILL = 0.1  # nats, a change that is not settled
_RIGHT = 0.01  # standard deviations of the states, by which one may be off for good
_MEDIAN = 0.05  # of a variation beforehand, in standard deviations of a parameter's prior
_SPREAD = 1.0  # of its logarithm
_ROUNDS = 60


class SmoothingWarning(UserWarning):
    """The states of a record did not settle."""


class Estimate(NamedTuple):
    """The states that stretches went through, and what decided that.

    Moments are of ``d`` states and after them the coordinates of the ``p`` unknown parameters.
    """

    stretches: list[Smoothed]
    noise: Array  # variances d of the errors of what is measured
    process_noise: Array  # variances d of what a step adds to the physics
    log_density: float  # of what was measured


class _End(NamedTuple):
    """Result of a search, and by how much the log density still changed, 0 if it arrived."""

    estimate: Estimate
    gained: float


def estimate(chain: Chain, max_rounds: int, num_starts: int, progress: bool) -> Estimate:
    """States, parameters of the physics and sizes of errors that explain stretches best.

    Each round linearises the physics along the trajectories found so far, smooths them (an iterated
    extended Kalman smoother, Bell 1994, with the unknown parameters as constants of the state) and
    takes the variances that are most likely given these (expectation maximisation, Shumway and
    Stoffer 1982). A new trajectory that explains less is taken part of the way only.

    Of several starts the best end counts. They are at the guesses of the parameters, and then at
    draws from their priors. Variances that are known come down to this from the sizes of f_p's
    errors in single steps, as a trajectory that may hardly leave the physics is often found by way
    of those that may; of every other start they are so from the beginning.

    Raises:
        PhysicsError: If the physics fails at the measured states.
        RuntimeError: If no start leads anywhere.

    Warns:
        SmoothingWarning: If there are no rounds left.
    """
    ends = list[_End]()
    with progress_bar(progress, total=num_starts * max_rounds, unit="round") as bar:
        for i, (coordinates, known_at_once) in enumerate(_starts(chain, num_starts)):
            bar.set_description(f"start {i + 1} of {num_starts}")
            bar.update(i * max_rounds - bar.n)  # a search that has settled leaves rounds
            try:
                # Far off numbers end; then another start may lead somewhere.
                with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):
                    ends.append(_search(chain, coordinates, known_at_once, max_rounds, bar))
            except PhysicsError:
                if not coordinates.any():  # at the guesses
                    raise
    if not ends:
        raise RuntimeError(
            f"The states diverged from each of {num_starts} starts. Give narrower priors of the "
            "parameters, a start of hidden states, more of the noise, or a larger num_starts."
        )
    # Log densities are to be compared where the variances that are known are so by then.
    best, gained = max(ends, key=lambda end: (abs(end.gained) <= _STILL, end.estimate.log_density))
    if abs(gained) > _STILL:
        warnings.warn(
            f"The states did not settle in {max_rounds} rounds. Raise max_rounds, say more of what "
            "is known (noise, process_noise, start), or look whether the physics is defined, and "
            "without jumps, about these states.",
            SmoothingWarning,
            stacklevel=3,
        )
    return best


def _starts(chain: Chain, number: int) -> Iterator[tuple[Array, bool]]:
    """Coordinates of the parameters, and whether variances that are known are so at once."""
    p = chain.num_parameters
    something_known = not np.isnan([chain.known.noise, chain.known.process_noise]).all()
    yield np.zeros(p), False
    if something_known and number > 1:
        yield np.zeros(p), True
    others = max(number - 2, 0) if something_known else number - 1
    if p and others:
        for i, coordinates in enumerate(even_normal(others, p, seed=0).numpy()):
            yield coordinates, something_known and i % 2 == 1


def _search(
    chain: Chain, coordinates: Array, known_at_once: bool, max_rounds: int, bar: Any
) -> _End:
    """Search from these parameters."""
    path = chain.first_path(coordinates)
    noise, process_noise = chain.first_variances(path)
    if known_at_once:
        noise, process_noise = chain.checked(noise, process_noise)
    value, steady = -math.inf, False
    for _ in range(max_rounds):
        bar.update()
        links = chain.linearised(path)
        starts = [(mean, np.diag(variance)) for mean, variance in chain.starts]
        found, density = smooth_chain(links, starts, noise, process_noise)
        if not math.isfinite(density):
            raise np.linalg.LinAlgError
        faster, gained, value = _LONGER if density >= value else 1.0, density - value, density
        estimate = Estimate(found, noise, process_noise, density)
        path, whole, refused = chain.towards(path, found, noise, process_noise)
        if not whole and not refused:
            continue
        if steady and abs(gained) < _ARRIVED:
            return _End(estimate, 0.0 if refused < _RIGHT else math.inf)
        likely = np.concatenate(chain.checked(*chain.likely_variances(links, found)))
        old = np.concatenate([noise, process_noise])
        moved = (faster * np.log(likely / old)).clip(-_NEARER, _NEARER)
        steady = bool((np.abs(moved) < _STEADY).all())
        noise, process_noise = np.split(old * np.exp(moved), 2)
    return _End(estimate, gained)


def variation(chain: Chain, found: Estimate) -> Tensor:
    r"""Standard deviations of stretches' parameters, ``p``, in those of the priors.

    With :math:`\theta_s = \theta + \eta_s` in the coordinates in which priors are standard normal,
    :math:`\eta_s \sim N(0, \operatorname{diag}(v^2))` for stretch s, and the noises as they were
    found, v is where its posterior density is highest (empirical Bayes for random effects,
    Laird and Ware 1982), with :math:`\log v \sim N(\log 0.05, 1)`: what the stretches say nothing
    of stays there.
    """
    precision, pull = _told(chain, found)
    start = math.log(_MEDIAN)
    log_v = torch.full_like(pull[0], start).requires_grad_()
    search = torch.optim.LBFGS([log_v], max_iter=_ROUNDS, line_search_fn="strong_wolfe")

    def cost() -> Tensor:
        search.zero_grad()
        prior = 0.5 * ((log_v - start) / _SPREAD).square().sum()
        value = prior - log_evidence(precision, pull, log_v.exp())
        value.backward()
        return value

    search.step(cost)
    return log_v.detach().exp()


def log_evidence(precision: Tensor, pull: Tensor, v: Tensor) -> Tensor:
    r"""The log density of all stretches by v, but for a constant.

    What stretch s says of its parameters is
    :math:`\exp(h_s^\top \theta_s - \theta_s^\top \Lambda_s \theta_s / 2)`; :math:`\eta_s`, and then
    :math:`\theta \sim N(0, I)`, are integrated out. Precisions :math:`\Lambda_s` are
    ``S x p x p``, pulls :math:`h_s` ``S x p``, standard deviations v of the :math:`\eta_s` ``p``.
    """
    eye = torch.eye(len(v), dtype=v.dtype)
    scaled, h = precision * v, pull * v  # Lambda_s V, V h_s
    root = torch.linalg.cholesky(eye + v.unsqueeze(-1) * scaled)
    shift = torch.cholesky_solve(h.unsqueeze(-1), root).squeeze(-1)
    own = 0.5 * (h * shift).sum() - root.diagonal(dim1=-2, dim2=-1).log().sum()
    shared = eye + (precision - scaled @ torch.cholesky_solve(scaled.mT, root)).sum(0)
    left = (pull - (scaled @ shift.unsqueeze(-1)).squeeze(-1)).sum(0).unsqueeze(-1)
    whole = torch.linalg.cholesky((shared + shared.mT) / 2)
    common = 0.5 * (left * torch.cholesky_solve(left, whole)).sum()
    return own + common - whole.diagonal().log().sum()


def _told(chain: Chain, found: Estimate) -> tuple[Tensor, Tensor]:
    """Precision and pull of each stretch, by smoothing it alone about the estimate by all."""
    d, p = len(found.noise), chain.num_parameters
    parameters = found.stretches[0].states.means[0, d:]
    path = chain.path([s.states.means[:, :d] for s in found.stretches], parameters)
    precisions, pulls = [], []
    for link, (mean, variance) in zip(chain.linearised(path), chain.starts, strict=True):
        mean, variance = mean.copy(), variance.copy()
        mean[d:], variance[d:] = parameters, 1.0  # a standard normal prior there
        start = mean, np.diag(variance)
        (alone,), _ = smooth_chain([link], [start], found.noise, found.process_noise)
        covariance = alone.states.covariances[0, d:, d:]
        # No stretch knows less than its prior, but by rounding.
        values, vectors = np.linalg.eigh(np.linalg.inv(covariance) - np.eye(p))
        precisions.append((vectors * values.clip(0)) @ vectors.T)
        pulls.append(np.linalg.solve(covariance, alone.states.means[0, d:] - parameters))
    return torch.from_numpy(np.stack(precisions)), torch.from_numpy(np.stack(pulls))
