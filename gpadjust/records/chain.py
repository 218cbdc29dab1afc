"""Stretches of records as a chain of states, linear near a path through them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch

from gpadjust.dynamics.targets import check_next_values
from gpadjust.physics import Physics, PhysicsError
from gpadjust.records.kalman import Array, Link, Smoothed, expected_squares
from gpadjust.records.record import Stretch
from gpadjust.states import StateSpec
from gpadjust.states.state_spec import side_by_side

_STEP = 1e-4  # of differences, in standard deviations of a parameter or a state
_WIDE = 10.0  # standard deviations of a state, by which the first one may be elsewhere
_SIZE = 1e-3  # of a state's size: it varies by no less
_SHARE = 0.25  # of the variance of f_p's errors in single steps: that of the noise at first
_HIDDEN = 0.1  # of the change in a step: what it adds to a state that is never measured, at first
_LEAST = 1e-6  # of the standard deviation of a state: no noise is less, but by rounding
_HALVINGS = 6
_BETTER = 0.01  # what a worse path may cost more, by rounding


class Known(NamedTuple):
    """Prior knowledge of the ``d`` states that move; variances are NaN where they are learnt."""

    noise: Array  # variances of the errors of what is measured
    process_noise: Array  # variances of what a step adds to the physics
    start: Mapping[int, tuple[float, float]]  # mean and sd at the beginning of a stretch, by number


class Path(NamedTuple):
    """States through the stretches, and what was measured, angles within half a turn of them."""

    states: list[Array]  # of each stretch, T + 1 x d
    measured: list[Array]
    parameters: Array  # p
    following: Array  # f_p there, sum T x d


class Move(NamedTuple):
    """Step of a search from a path."""

    path: Path
    whole: bool  # whether it is the one that was found, and not on the way or the one before
    refused: float  # how far in sd of the states a path was that explains less; 0 if one was taken


class Chain:
    """Stretches, the physics that leads through them, and what is known beforehand."""

    def __init__(
        self, physics: Physics, spec: StateSpec, stretches: Sequence[Stretch], known: Known
    ) -> None:
        self.physics, self.stretches, self.known = physics, tuple(stretches), known
        self.spec = spec
        self.num_parameters = len(physics.unknowns)
        moving = spec.moving
        self.angles = [moving.index(i) for i in spec.angle_columns if i in moving]
        rows = [side_by_side(stretch.states[:-1], stretch.actions) for stretch in stretches]
        self.recorded = torch.cat(rows)  # of which f_p reads what does not move
        self.measured = [
            self._unwrapped(stretch.states[:, moving].numpy()) for stretch in stretches
        ]
        self.middle, self.spread = self._sizes()
        self.starts = [self._start(measured) for measured in self.measured]

    def first_path(self, parameters: Array) -> Path:
        """Measured states, and between them and in hidden ones where f_p leads."""
        lengths = [len(m) for m in self.measured]
        states, measured = ([m.copy() for m in self.measured] for _ in range(2))
        bounds = np.cumsum([0, *(n - 1 for n in lengths)])
        now = np.stack([start[: len(self.spread)] for start, _ in self.starts])
        complete = not np.isnan(np.concatenate(measured)).any()
        for t in range(max(lengths)):
            going = [i for i, n in enumerate(lengths) if n > t]
            rows = np.stack([measured[i][t] for i in going])
            if not complete and t:  # after a gap the angle may have gone round
                rows[:, self.angles] = _near(rows, now[going], self.angles)
                for i, row in zip(going, rows, strict=True):
                    measured[i][t] = row
            now[going] = np.where(np.isnan(rows), now[going], rows)
            for i in going:
                states[i][t] = now[i]
            onward = [i for i in going if lengths[i] > t + 1]
            if onward and not complete:
                recorded = self.recorded[[bounds[i] + t for i in onward]]
                now[onward] = self._following(now[onward], recorded, parameters)
        everything = np.concatenate([x[:-1] for x in states])
        following = self._following(everything, self.recorded, parameters)
        return Path(states, measured, parameters, following)

    def path(self, states: list[Array], parameters: Array) -> Path:
        """The path of these states, NaN where f_p fails."""
        measured = [m.copy() for m in self.measured]
        for own, there in zip(measured, states, strict=True):
            own[:, self.angles] = _near(own, there, self.angles)
        rows = np.concatenate([x[:-1] for x in states])
        return Path(states, measured, parameters, self.asked(rows, self.recorded, parameters))

    def first_variances(self, path: Path) -> tuple[Array, Array]:
        """First variances of both noises, by f_p's errors in single steps."""
        ends = np.concatenate([m[1:] for m in path.measured])
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

    def checked(self, noise: Array, process_noise: Array) -> tuple[Array, Array]:
        """Variances with what is known of them, and none too small to reckon with."""
        least = (_LEAST * self.spread) ** 2
        pairs = ((self.known.noise, noise), (self.known.process_noise, process_noise))
        noise, process_noise = (
            np.where(np.isnan(given), found, given).clip(least) for given, found in pairs
        )
        return noise, process_noise

    def linearised(self, path: Path) -> list[Link]:
        """The chain near a path, by central differences."""
        d, p = len(self.spread), self.num_parameters
        states, N = np.concatenate([x[:-1] for x in path.states]), len(path.following)
        moves = np.vstack([np.diag(_STEP * self.spread), np.zeros((p, d))])
        turns = np.vstack([np.zeros((d, p)), _STEP * np.eye(p)])
        beside = [(states + s * moves[:, None], path.parameters + s * turns) for s in (1.0, -1.0)]
        ends = [self.asked(near, self.recorded, parameters) for near, parameters in beside]
        sizes = 2 * np.concatenate([_STEP * self.spread, _STEP * np.ones(p)])
        slope = (ends[0] - ends[1]) / sizes[:, None, None]
        matrices = np.zeros((N, d + p, d + p))
        matrices[:, :d] = np.moveaxis(np.nan_to_num(slope), 0, -1)  # 0 where f_p fails nearby
        matrices[:, d:, d:] = np.eye(p)
        here = np.concatenate([states, np.broadcast_to(path.parameters, (N, p))], axis=1)
        onward = np.concatenate([path.following, here[:, d:]], axis=1)
        offsets = onward - np.einsum("tij,tj->ti", matrices, here)
        cuts = np.cumsum([len(m) - 1 for m in path.measured])[:-1]
        parts = zip(np.split(matrices, cuts), np.split(offsets, cuts), path.measured, strict=True)
        return [
            Link(matrix, offset, np.tile(np.eye(d, d + p), (len(m), 1, 1)), m)
            for matrix, offset, m in parts
        ]

    def towards(
        self, path: Path, found: Sequence[Smoothed], noise: Array, process_noise: Array
    ) -> Move:
        """The path that was found, or as much of the way there as explains more."""
        d = len(self.spread)
        ahead = [smoothed.states.means[:, :d] for smoothed in found]
        parameters = found[0].states.means[0, d:]
        before, share = self.cost(path, noise, process_noise), 1.0
        for _ in range(_HALVINGS):
            states = [x + share * (y - x) for x, y in zip(path.states, ahead, strict=True)]
            moved = path.parameters + share * (parameters - path.parameters)
            rows = np.concatenate([x[:-1] for x in states])
            following = self.asked(rows, self.recorded, moved)
            other = Path(states, path.measured, moved, following)
            cost = self.cost(other, noise, process_noise)
            if cost <= before + _BETTER:  # false of NaN
                return Move(other, share == 1.0, 0.0)
            share /= 2
        pairs = zip(ahead, path.states, strict=True)
        far = max(float((np.abs(y - x) / self.spread).max()) for y, x in pairs)
        return Move(path, False, far)

    def likely_variances(
        self, links: Sequence[Link], found: Sequence[Smoothed]
    ) -> tuple[Array, Array]:
        """Variances of noise and process_noise, most likely given the states' distribution."""
        measured, added = expected_squares(links, found, len(self.spread))
        columns = zip(self._columns(measured), self.spread, strict=True)
        noise = [np.nanmean(c) if ok else size**2 for (c, ok), size in columns]  # or any number
        return np.array(noise), added.mean(0)

    def cost(self, path: Path, noise: Array, process_noise: Array) -> float:
        """Twice the negative log density of a path, but for a constant; NaN where f_p fails."""
        states, d = np.concatenate(path.states), len(self.spread)
        off = np.nan_to_num(states - np.concatenate(path.measured), nan=0.0) ** 2 / noise
        ends = np.concatenate([x[1:] for x in path.states])
        added = (ends - path.following) ** 2 / process_noise
        begins = sum(
            (((x[0] - mean[:d]) ** 2) / variance[:d]).sum()
            for x, (mean, variance) in zip(path.states, self.starts, strict=True)
        )
        return float(off.sum() + added.sum() + begins + (path.parameters**2).sum())

    def _following(self, states: Array, recorded: torch.Tensor, parameters: Array) -> Array:
        """Next states by f_p, ``n x d``; an error where it fails."""
        found = self.asked(states, recorded, parameters)
        if not np.isfinite(found).all():
            failed = np.flatnonzero(~np.isfinite(found).all(1))
            action = recorded[failed[0], self.spec.state_dim :].tolist()
            raise PhysicsError(
                f"Physics {self.physics.name!r} fails at {len(failed)} of {len(found)} states "
                f"where smoothing begins, the first of which is {states[failed[0]].tolist()} under "
                f"the action {action}. They are measured ones, which may be "
                "some noise beyond what is possible, or where the physics leads from `start` with "
                "its guesses: let it go on smoothly beyond its limits, or say another start."
            )
        return found

    def asked(self, states: Array, recorded: torch.Tensor, parameters: Array) -> Array:
        """Next states ``... x n x d``, NaN where f_p fails, of angles near those of ``states``."""
        rows = recorded.expand(*states.shape[:-1], -1).clone()
        rows[..., self.spec.moving] = torch.from_numpy(np.ascontiguousarray(states))
        X = rows[..., self.spec.physics_columns]
        unknowns = self.physics.unknowns
        values = unknowns.at(torch.from_numpy(parameters)) if unknowns else None
        found: Array = self.physics.or_nan(X, values).numpy()
        check_next_values(self.physics, torch.from_numpy(found), states.shape[-1])
        found[..., self.angles] = _near(found, states, self.angles)
        return found

    def _sizes(self) -> tuple[Array, Array]:
        """The middle of each state, and by how much it varies, as far as is known."""
        everything = np.concatenate(self.measured)
        sizes = np.empty((2, everything.shape[1]))
        for i, (column, ok) in enumerate(self._columns(everything)):
            measured = column[~np.isnan(column)] if ok else np.zeros(0)
            middle, sd = self.known.start.get(i, (measured.mean() if ok else 0.0, 0.0))
            if len(measured) > 1:
                middle, sd = measured.mean(), max(sd, measured.std())
            size = max(abs(middle), np.abs(measured).max(initial=0.0))
            sizes[:, i] = middle, max(sd, _SIZE * (size or 1.0))
        return sizes[0], sizes[1]

    def _start(self, measured: Array) -> tuple[Array, Array]:
        """Means and variances ``d + p`` of the first state of a stretch, and of the parameters."""
        mean, sd = self.middle.copy(), _WIDE * self.spread
        for i, (column, ok) in enumerate(self._columns(measured)):
            if ok:
                mean[i] = column[np.flatnonzero(~np.isnan(column))[0]]
        for i, (middle, width) in self.known.start.items():
            mean[i], sd[i] = middle, width
        p = self.num_parameters
        return np.concatenate([mean, np.zeros(p)]), np.concatenate([sd**2, np.ones(p)])

    def _unwrapped(self, measured: Array) -> Array:
        """Measured states of a stretch, whose angles go on without jumps."""
        for i in self.angles:
            rows = ~np.isnan(measured[:, i])
            measured[rows, i] = np.unwrap(measured[rows, i])
        return measured

    @staticmethod
    def _columns(rows: Array) -> list[tuple[Array, bool]]:
        """Each column, and whether anything was measured of it."""
        return [(column, not np.isnan(column).all()) for column in rows.T]


def _near(states: Array, others: Array, angles: Sequence[int]) -> Array:
    """Angles of states ``... x d``, within half a turn of those of others."""
    columns = [*angles]
    turns = np.round((states[..., columns] - others[..., columns]) / (2 * np.pi))
    found: Array = states[..., columns] - 2 * np.pi * turns
    return found
