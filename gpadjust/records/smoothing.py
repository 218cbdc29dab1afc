"""The states that a machine was in, from noisy and incomplete records and a physics."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from gpadjust.physics import Physics, PhysicsError
from gpadjust.records.chain import Chain, Known
from gpadjust.records.kalman import Array, Smoothed, smooth_chain
from gpadjust.records.stretches import Stretch
from gpadjust.states import StateSpec

_LONGER = 1.6  # than a step of expectation maximisation, in logarithms
_NEARER = math.log(4)  # the most that a logarithm of a variance changes in a round
_ARRIVED = 0.01  # nats of the log density
_STEADY = 0.05  # a change of the logarithm of a variance
_STILL = 0.1  # nats, a change that is not settled
_RIGHT = 0.01  # standard deviations of the states, by which one may be off for good


class SmoothingWarning(UserWarning):
    """The states of a record did not settle."""


class Estimate(NamedTuple):
    """The states that stretches went through, and what decided that.

    Args:
        stretches: Moments of their states, ``T + 1 x (d + p)``: after the ``d`` states come the
            coordinates of the unknown parameters.
        noise: Variances ``d`` of the errors of what is measured.
        process_noise: Variances ``d`` of what a step adds to the physics.
        log_density: Of what was measured.
    """

    stretches: list[Smoothed]
    noise: Array
    process_noise: Array
    log_density: float


class _End(NamedTuple):
    """What a search found, and by how much the log density still changed, 0 if it arrived."""

    estimate: Estimate
    gained: float


def estimate(
    physics: Physics,
    spec: StateSpec,
    stretches: Sequence[Stretch],
    known: Known,
    max_rounds: int,
    num_starts: int,
) -> Estimate:
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
    chain, ends = Chain(physics, spec, stretches, known), list[_End]()
    for coordinates, known_at_once in _starts(chain, num_starts):
        try:
            # Far off numbers end; then another start may lead somewhere.
            with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):
                ends.append(_search(chain, coordinates, known_at_once, max_rounds))
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
        engine = torch.quasirandom.SobolEngine(p, scramble=True, seed=0)
        shares = engine.draw(others, dtype=torch.float64).clamp(1e-6, 1 - 1e-6)
        for i, coordinates in enumerate(torch.special.ndtri(shares).numpy()):
            yield coordinates, something_known and i % 2 == 1


def _search(chain: Chain, coordinates: Array, known_at_once: bool, max_rounds: int) -> _End:
    """What is found from parameters."""
    path = chain.first_path(coordinates)
    noise, process_noise = chain.first_variances(path)
    if known_at_once:
        noise, process_noise = chain.checked(noise, process_noise)
    value, steady = -math.inf, False
    for _ in range(max_rounds):
        links = chain.linearised(path)
        found, density = smooth_chain(links, chain.starts, noise, process_noise)
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
