"""The states that a machine was in, from noisy and incomplete records and a physics."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from gpadjust.dynamics.control_steps import Stretch
from gpadjust.dynamics.kalman import Array, Link, Smoothed, smooth
from gpadjust.physics import Physics, PhysicsError
from gpadjust.states import StateSpec

_STEP = 1e-4  # of differences, in standard deviations of a parameter or a state
_WIDE = 10.0  # standard deviations of a state, by which the first one may be elsewhere
_SHARE = 0.25  # of the variance of f_p's errors in single steps: that of the noise at first
_HIDDEN = 0.1  # of the change in a step: what it adds to a state that is never measured, at first
_LEAST = 1e-6  # of the standard deviation of a state: no noise is less, but by rounding
_LONGER = 1.6  # than a step of expectation maximisation, in logarithms
_NEARER = math.log(4)  # the most that a logarithm of a variance changes in a round
_HALVINGS = 6
_ARRIVED = 0.01  # nats of the log density
_STILL = 0.1  # nats, a change that is not settled


class SmoothingWarning(UserWarning):
    """The states of a record did not settle."""


class Known(NamedTuple):
    """What is known beforehand, of the ``d`` states that move.

    Args:
        noise: Variances of the errors of what is measured; NaN where they are learnt.
        scatter: Variances of what a step adds to the physics; NaN where they are learnt.
        start: Of states by number, mean and standard deviation at the beginning of a stretch.
    """

    noise: Array
    scatter: Array
    start: Mapping[int, tuple[float, float]]


class Estimate(NamedTuple):
    """The states that stretches went through, and what decided that.

    Args:
        stretches: Moments of their states, ``T + 1 x (d + p)``: after the ``d`` states come the
            coordinates of the unknown parameters.
        noise: Variances ``d`` of the errors of what is measured.
        scatter: Variances ``d`` of what a step adds to the physics.
        log_density: Of what was measured.
    """

    stretches: list[Smoothed]
    noise: Array
    scatter: Array
    log_density: float


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
    chain = _Chain(physics, spec, stretches, known)
    p, found = chain.num_parameters, []
    engine = torch.quasirandom.SobolEngine(max(p, 1), scramble=True, seed=0)
    shares = engine.draw(num_starts, dtype=torch.float64).clamp(1e-6, 1 - 1e-6)
    places = torch.special.ndtri(shares)[:, :p].numpy()
    something_known = not np.isnan(np.concatenate([known.noise, known.scatter])).all()
    at_guesses = 2 if something_known else 1
    places[:at_guesses] = 0.0
    for i, coordinates in enumerate(places):
        try:
            path = chain.first_path(coordinates)
        except PhysicsError:
            if i < at_guesses:
                raise
            continue
        # Far off numbers end; then another start may lead somewhere.
        with (
            contextlib.suppress(np.linalg.LinAlgError),
            np.errstate(over="ignore", invalid="ignore"),
        ):
            found.append(_from(chain, path, known_at_once=i % 2 == 1, max_rounds=max_rounds))
    if not found:
        raise RuntimeError(
            f"The states diverged from each of {num_starts} starts. Give narrower priors of the "
            "parameters, a start of hidden states, more of the noise, or a larger num_starts."
        )
    # By what was measured, but only where the variances that are known are so by then.
    best, gained = max(found, key=lambda end: (abs(end[1]) <= _STILL, end[0].log_density))
    if abs(gained) > _STILL:
        warnings.warn(
            f"The states did not settle in {max_rounds} rounds: the log density of what was "
            f"measured still changed by {gained:.2g}. Raise max_rounds, say more of what is known "
            "(noise, process_noise, start), or look at the physics.",
            SmoothingWarning,
            stacklevel=4,
        )
    return best


def _from(
    chain: _Chain, path: _Path, *, known_at_once: bool, max_rounds: int
) -> tuple[Estimate, float]:
    """What is found from a path, and by how much the log density changed in the last round."""
    noise, scatter = chain.first_variances(path)
    if known_at_once:
        noise, scatter = chain.checked(noise, scatter)
    value = -math.inf
    for _ in range(max_rounds):
        links = chain.linearised(path)
        found, density = smooth(links, chain.starts, noise, scatter)
        if not math.isfinite(density):
            raise np.linalg.LinAlgError
        faster, gained, value = _LONGER if density >= value else 1.0, density - value, density
        estimate = Estimate(found, noise, scatter, density)
        path, whole = chain.towards(path, found, noise, scatter)
        likely = chain.checked(*chain.likely_variances(links, found))
        if not whole:
            continue
        if abs(gained) < _ARRIVED:
            return estimate, 0.0
        noise, scatter = (
            old * np.exp((faster * np.log(new / old)).clip(-_NEARER, _NEARER))
            for old, new in zip((noise, scatter), likely, strict=True)
        )
    return estimate, gained


class _Path(NamedTuple):
    """States of each stretch, ``T + 1 x d``, parameters ``p``, and f_p there: ``sum T x d``."""

    states: list[Array]
    parameters: Array
    following: Array


class _Chain:
    """Stretches, and the physics that leads through them.

    Args:
        physics: The physics.
        spec: What the entries of states and actions are.
        stretches: The stretches.
        known: What is known beforehand.
    """

    def __init__(
        self, physics: Physics, spec: StateSpec, stretches: Sequence[Stretch], known: Known
    ) -> None:
        self.physics, self.known = physics, known
        self.num_parameters = len(physics.unknowns)
        moving = spec.moving
        self.angles = [moving.index(i) for i in spec.angle_columns if i in moving]
        self.actions = torch.cat([stretch.actions for stretch in stretches])
        self.measured = [self._unwrapped(s.states[:, moving].numpy()) for s in stretches]
        everything = np.concatenate(self.measured)
        columns = enumerate(self._columns(everything))
        spread = np.array([np.nanstd(c) if ok else known.start[i][1] for i, (c, ok) in columns])
        self.spread = spread.clip(np.finfo(float).tiny ** 0.25)
        self.starts = [self._start(measured) for measured in self.measured]

    def first_path(self, parameters: Array) -> _Path:
        """Measured states, and between them and in hidden ones where f_p leads.

        Args:
            parameters: Its parameters' coordinates, ``p``.
        """
        measured, lengths = self.measured, [len(m) for m in self.measured]
        states = [np.empty_like(m) for m in measured]
        bounds = np.cumsum([0, *(n - 1 for n in lengths)])
        now = np.stack([start[: len(self.spread)] for start, _ in self.starts])
        complete = not np.isnan(np.concatenate(measured)).any()
        for t in range(max(lengths)):
            going = [i for i, n in enumerate(lengths) if n > t]
            rows = np.stack([measured[i][t] for i in going])
            now[going] = np.where(np.isnan(rows), now[going], rows)
            for i in going:
                states[i][t] = now[i]
            onward = [i for i in going if lengths[i] > t + 1]
            if onward and not complete:
                actions = self.actions[[bounds[i] + t for i in onward]]
                now[onward] = self._following(now[onward], actions, parameters)
        everything = np.concatenate([x[:-1] for x in states])
        return _Path(states, parameters, self._following(everything, self.actions, parameters))

    def first_variances(self, path: _Path) -> tuple[Array, Array]:
        """Of noise and scatter, by f_p's errors in single steps, whatever is known of them."""
        ends = np.concatenate([m[1:] for m in self.measured])
        begins = np.concatenate([x[:-1] for x in path.states])
        change = ((path.following - begins) ** 2).mean(0)
        errors = np.array(
            [
                np.nanmean((c - path.following[:, i]) ** 2) if ok else _HIDDEN**2 * change[i]
                for i, (c, ok) in enumerate(self._columns(ends))
            ]
        )
        least = (_LEAST * self.spread) ** 2
        return (_SHARE * errors).clip(least), (2 * _SHARE * errors).clip(least)

    def checked(self, noise: Array, scatter: Array) -> tuple[Array, Array]:
        """Variances with what is known of them, and none too small to reckon with."""
        least = (_LEAST * self.spread) ** 2
        pairs = ((self.known.noise, noise), (self.known.scatter, scatter))
        noise, scatter = (
            np.where(np.isnan(given), found, given).clip(least) for given, found in pairs
        )
        return noise, scatter

    def linearised(self, path: _Path) -> list[Link]:
        """The chain near a path, by central differences."""
        d, p = len(self.spread), self.num_parameters
        states, N = np.concatenate([x[:-1] for x in path.states]), len(path.following)
        moves = np.vstack([np.diag(_STEP * self.spread), np.zeros((p, d))])
        turns = np.vstack([np.zeros((d, p)), _STEP * np.eye(p)])
        ends = [
            self._asked(
                states + sign * moves[:, None], self.actions, path.parameters + sign * turns
            )
            for sign in (1.0, -1.0)
        ]
        sizes = 2 * np.concatenate([_STEP * self.spread, _STEP * np.ones(p)])
        slope = (ends[0] - ends[1]) / sizes[:, None, None]
        matrices = np.zeros((N, d + p, d + p))
        matrices[:, :d] = np.moveaxis(np.nan_to_num(slope), 0, -1)
        matrices[:, d:, d:] = np.eye(p)
        here = np.concatenate([states, np.broadcast_to(path.parameters, (N, p))], axis=1)
        onward = np.concatenate([path.following, here[:, d:]], axis=1)
        offsets = onward - np.einsum("tij,tj->ti", matrices, here)
        cuts = np.cumsum([len(m) - 1 for m in self.measured])[:-1]
        parts = zip(np.split(matrices, cuts), np.split(offsets, cuts), self.measured, strict=True)
        return [Link(*part) for part in parts]

    def towards(
        self, path: _Path, found: Sequence[Smoothed], noise: Array, scatter: Array
    ) -> tuple[_Path, bool]:
        """The path that was found, or as much of the way there as explains more; whether all."""
        d = len(self.spread)
        ahead = [smoothed.states.means[:, :d] for smoothed in found]
        parameters = found[0].states.means[0, d:]
        before, share = self._cost(path, noise, scatter), 1.0
        for _ in range(_HALVINGS):
            states = [x + share * (y - x) for x, y in zip(path.states, ahead, strict=True)]
            moved = path.parameters + share * (parameters - path.parameters)
            rows = np.concatenate([x[:-1] for x in states])
            other = _Path(states, moved, self._asked(rows, self.actions, moved))
            cost = self._cost(other, noise, scatter)
            if cost <= before + _ARRIVED:  # false of NaN
                return other, share == 1.0
            share /= 2
        return path, True  # as near as rounding lets it come

    def likely_variances(
        self, links: Sequence[Link], found: Sequence[Smoothed]
    ) -> tuple[Array, Array]:
        """Of noise and scatter, most likely given what is known of the states."""
        d = len(self.spread)
        errors, added = [], []
        for link, (states, crossed) in zip(links, found, strict=True):
            means, spread = states.means[:, :d], states.covariances[:, :d, :d]
            own = (link.measured - means) ** 2 + np.diagonal(spread, axis1=1, axis2=2)
            errors.append(own)
            lead = link.matrices[:, :d]
            step = means[1:] - np.einsum("tij,tj->ti", lead, states.means[:-1])
            step = step - link.offsets[:, :d]
            of_both = np.einsum("tij,tij->ti", crossed[:, :d], lead)
            of_first = np.einsum("tij,tjk,tik->ti", lead, states.covariances[:-1], lead)
            of_last = np.diagonal(spread[1:], axis1=1, axis2=2)
            added.append(step**2 + (of_last - 2 * of_both + of_first).clip(0))
        measured = np.concatenate(errors)
        noise = [np.nanmean(c) if ok else math.nan for c, ok in self._columns(measured)]
        return np.array(noise), np.concatenate(added).mean(0)

    def _cost(self, path: _Path, noise: Array, scatter: Array) -> float:
        """Twice the negative log density of a path, but for a constant; NaN where f_p fails."""
        states, d = np.concatenate(path.states), len(self.spread)
        off = np.nan_to_num(states - np.concatenate(self.measured)) ** 2 / noise
        ends = np.concatenate([x[1:] for x in path.states])
        added = (ends - path.following) ** 2 / scatter
        begins = sum(
            (((x[0] - mean[:d]) ** 2) / variance[:d]).sum()
            for x, (mean, variance) in zip(path.states, self.starts, strict=True)
        )
        return float(off.sum() + added.sum() + begins + (path.parameters**2).sum())

    def _following(self, states: Array, actions: torch.Tensor, parameters: Array) -> Array:
        """What f_p says, ``n x d``; an error if that is nothing."""
        found = self._asked(states, actions, parameters)
        if not np.isfinite(found).all():
            failed = np.flatnonzero(~np.isfinite(found).all(1))
            raise PhysicsError(
                f"Physics {self.physics.name!r} fails at {len(failed)} of {len(found)} of the "
                f"measured states, the first of which is {states[failed[0]].tolist()} under the "
                f"action {actions[failed[0]].tolist()}; smoothing needs it there. Correct the "
                "physics, or leave those rows out."
            )
        return found

    def _asked(self, states: Array, actions: torch.Tensor, parameters: Array) -> Array:
        """Next states ``... x n x d``, NaN where f_p fails, of angles near those of ``states``."""
        rows = torch.from_numpy(np.ascontiguousarray(states))
        X = torch.cat([rows, actions.expand(*rows.shape[:-1], -1)], dim=-1)
        unknowns = self.physics.unknowns
        values = unknowns.at(torch.from_numpy(parameters)) if unknowns else None
        found: Array = self.physics.or_nan(X, values).numpy()
        angles = found[..., self.angles] - states[..., self.angles]
        found[..., self.angles] -= 2 * np.pi * np.round(angles / (2 * np.pi))
        return found

    def _start(self, measured: Array) -> tuple[Array, Array]:
        """Means and variances ``d + p`` of the first state of a stretch, and of the parameters."""
        mean, sd = np.zeros(len(self.spread)), _WIDE * self.spread
        for i, (column, ok) in enumerate(self._columns(measured)):
            mean[i] = column[np.flatnonzero(~np.isnan(column))[0]] if ok else 0.0
        for i, (middle, width) in self.known.start.items():
            mean[i], sd[i] = middle, width
        p = self.num_parameters
        return np.concatenate([mean, np.zeros(p)]), np.concatenate([sd**2, np.ones(p)])

    def _unwrapped(self, measured: Array) -> Array:
        """Measured states whose angles go on without jumps."""
        measured = measured.copy()
        for i in self.angles:
            rows = ~np.isnan(measured[:, i])
            measured[rows, i] = np.unwrap(measured[rows, i])
        return measured

    @staticmethod
    def _columns(rows: Array) -> list[tuple[Array, bool]]:
        """Each column, and whether anything was measured of it."""
        return [(column, not np.isnan(column).all()) for column in rows.T]
