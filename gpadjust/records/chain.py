"""Records of a machine as a chain of states, which its physics leads through."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import check_kind, finite_array
from gpadjust.dynamics.base import of_states
from gpadjust.dynamics.physics_dynamics import check_next_values, one_physics
from gpadjust.physics import Physics, PhysicsError
from gpadjust.physics.parameters import even_normal
from gpadjust.records import kalman
from gpadjust.records.kalman import Array, Link, Smoothed
from gpadjust.records.records import Records, control_steps
from gpadjust.records.sensing import Sensing
from gpadjust.states import Sensors, StateSpec
from gpadjust.states.state_spec import side_by_side

_SAME = 0.01  # of a step, by which another one may differ from it
_STEP = 1e-4  # of differences, in standard deviations of a parameter or a state
_JUMP = 2.0  # a change of the slope within these, in standard deviations of a state, or more
_WIDE = 10.0  # standard deviations of a state, by which the first one may be elsewhere
_SIZE = 1e-3  # of a state's size: it varies by no less
_SHARE = 0.25  # of the variance of f_p's errors in single steps: that of the noise at first
_HIDDEN = 0.1  # of the change in a step: what it adds to a state that is never measured, at first
_LEAST = 1e-6  # of the standard deviation of a state: the least noise
_HALVINGS = 6
_BETTER = 0.01  # what a worse path may cost more, by rounding


class Estimate(NamedTuple):
    """The states of all stretches, and the variances by which they were found.

    Moments are of ``d`` states and after them the coordinates of the ``p`` unknown parameters.
    """

    stretches: list[Smoothed]
    states: Array  # their means, one stretch after the other, M x (d + p)
    variances: Array  # of noise and process noise, 2 x d
    log_density: float  # of the measurements

    def of_parameters(self, d: int) -> tuple[Array, Array]:
        """Return mean and covariance of the parameters, which come after ``d`` states."""
        means, covariances = self.stretches[0].states
        return means[0, d:], covariances[0, d:, d:]


class Path(NamedTuple):
    """States through all stretches, and the measurements, angles within half a turn of them."""

    states: Array  # M x d
    measured: Array  # M x d
    parameters: Array  # p
    following: Array  # f_p there, N x d


class Chain:
    """All stretches, the physics that leads through them, and what is known beforehand.

    Rows of the stretches are one after the other: ``M`` states, of which ``N`` are followed by
    another one. Known are variances of noise and process noise, and mean and standard deviation of
    first states, ``2 x d`` each; NaN where they are not. A ValueError refuses records without
    measurements, and hidden states without a start.
    """

    def __init__(
        self,
        physics: Physics,
        steps: Records,
        variances: Array,
        start: Array,
        substeps: int = 1,
        sensors: Sensors | None = None,
    ) -> None:
        self.physics = physics
        self.steps = steps
        self.spec = steps.spec
        moving = self.spec.moving
        mean, sd = start
        names = [self.spec.states[i] for i in moving]
        self.sensing: Sensing | None = None
        self.unknowns = physics.unknowns
        if sensors is not None:
            sensing = Sensing(sensors, physics, self.spec, steps.records[0].sampling_step)
            self.sensing = sensing if sensing.places else None
            self.unknowns = sensing.unknowns
        self.d = len(moving)
        self.num_parameters = len(self.unknowns)
        self.angles = [moving.index(i) for i in self.spec.angle_columns if i in moving]
        self.lengths = np.array([len(record.times) for record in steps])
        ends = self.lengths.cumsum()
        self.firsts = ends - self.lengths
        self.stretches = [slice(*rows) for rows in zip(self.firsts, ends, strict=True)]
        self.now = np.setdiff1d(np.arange(ends[-1]), ends - 1)  # rows that another one follows
        states = torch.cat([record.states for record in steps])
        actions = torch.cat([record.actions for record in steps])
        self.recorded = side_by_side(states, actions)  # of which f_p reads what does not move
        self.within = actions.unsqueeze(1)  # of the steps of f_p in a control step
        if substeps > 1:
            self.within = torch.cat([record.within for record in steps])
        y = self.measured = states[:, moving].numpy()
        for rows in self.stretches:
            for i in self.angles:  # without jumps
                places = rows.start + np.flatnonzero(~np.isnan(y[rows, i]))
                y[places, i] = np.unwrap(y[places, i])
            for i, longest in enumerate([] if self.sensing is None else self.sensing.longest):
                y[rows][:longest, i] = math.nan
        y = self.corrected(y, np.zeros(self.num_parameters))
        self.hidden = np.isnan(y).all(0)
        if self.hidden.all():
            raise ValueError(f"Expected measured states, found none of {', '.join(names)}.")
        for column in np.flatnonzero(self.hidden & np.isnan(mean)):
            name = repr(names[column])
            raise ValueError(
                f"State {name} was never measured; give mean and standard deviation of where it "
                f"may be at the beginning of a stretch, such as start={{{name}: (0.0, 1.0)}}."
            )
        # By how much each state varies, as far as is known
        middle = _means(y, otherwise=0.0)
        varies = np.fmax(sd, np.sqrt(_means((y - middle) ** 2, otherwise=0.0)))
        middle = np.where(((~np.isnan(y)).sum(0) < 2) & ~np.isnan(mean), mean, middle)
        size = np.maximum(np.abs(middle), np.nan_to_num(np.abs(y)).max(0))
        self.spread = np.fmax(varies, _SIZE * np.where(size > 0, size, 1.0))
        self.least = (_LEAST * self.spread) ** 2
        # First states: as is known, or about the first number of a stretch
        numbers = np.stack([rows.start + np.isnan(y[rows]).argmin(0) for rows in self.stretches])
        first = y[numbers, np.arange(self.d)]
        first = np.where(np.isnan(first), middle, first)
        self.first = np.where(np.isnan(mean), first, mean)  # S x d
        self.first_variance = np.where(np.isnan(sd), _WIDE * self.spread, sd) ** 2
        self.something_is_known = not np.isnan(variances).all()
        self.known_variances = variances.copy()
        self.known_variances[0, self.hidden] = self.spread[self.hidden] ** 2  # any number
        self.is_known = ~np.isnan(self.known_variances)
        self.counts = np.stack([(~np.isnan(y)).sum(0), np.full(self.d, len(self.now))])
        p = self.num_parameters  # standard normal a priori
        covariance = np.diag(np.concatenate([self.first_variance, np.ones(p)]))
        self.starts = [(np.concatenate([x, np.zeros(p)]), covariance) for x in self.first]

    def starts_of_search(self, number: int) -> Iterator[tuple[Array, bool]]:
        """Yield coordinates of the parameters, and if known variances are so from the beginning.

        They are the guesses, then draws from the priors. Known variances begin with the squares of
        f_p's errors, as a path that must follow the physics is often found by way of others, but
        in every other start.
        """
        p = self.num_parameters
        something_known = self.something_is_known
        starts = [np.zeros(p)] * (1 + something_known)
        if p and number > len(starts):
            starts += [*even_normal(number - len(starts), p, seed=0).numpy()]
        for i, coordinates in enumerate(starts[:number]):
            yield coordinates, something_known and i % 2 == 1

    def first_path(self, parameters: Array) -> Path:
        """Return measured states, and between them and in hidden ones those to which f_p leads."""
        measured = self.corrected(self.measured, parameters).copy()
        states = measured.copy()
        x = self.first.copy()
        for t in range(self.lengths.max() if np.isnan(measured).any() else 0):
            going = self.lengths > t
            rows = self.firsts[going] + t
            if t:  # after a gap the angle may have gone round
                measured[rows] = self.near(measured[rows], x[going])
            states[rows] = np.where(np.isnan(measured[rows]), x[going], measured[rows])
            x[going] = states[rows]
            going = self.lengths > t + 1
            if going.any():
                x[going] = self._defined(self.firsts[going] + t, x[going], parameters)
        following = self._defined(self.now, states[self.now], parameters)
        if self.sensing is not None:
            measured = self.near(self.measured, self.outputs(states, parameters))
        return Path(states, measured, parameters, following)

    def corrected(self, measured: Array, parameters: Array) -> Array:
        """Return the states ``M x d`` that measurements show."""
        if self.sensing is None:
            return measured
        return self.sensing.corrected(measured, parameters, self.stretches)

    def outputs(self, states: Array, parameters: Array) -> Array:
        """Return what the sensors show of states ``M x d``."""
        if self.sensing is None:
            return states
        return self.sensing.outputs(states, parameters, self.stretches)

    def gain(self, parameters: Array) -> Array:
        """Return sizes of the gains of the sensors, ``d``."""
        if self.sensing is None:
            return np.ones(self.d)
        return np.abs(self.sensing.values(parameters)[0])

    def path_of(self, estimate: Estimate) -> Path:
        """Return the path of an estimate."""
        states, parameters = estimate.states[:, : self.d], estimate.states[0, self.d :]
        following = self.follow(self.now, states[self.now], parameters)
        measured = self.near(self.measured, self.outputs(states, parameters))
        return Path(states, measured, parameters, following)

    def first_variances(self, path: Path) -> Array:
        """Return first variances of both noises, by f_p's errors in single steps."""
        change = ((path.following - path.states[self.now]) ** 2).mean(0)
        shown = self.corrected(path.measured, path.parameters)
        errors = ((shown[self.now + 1] - path.following) * self.gain(path.parameters)) ** 2
        noise = _SHARE * _means(errors, otherwise=_HIDDEN**2 * change)
        return np.stack([noise, 2 * noise]).clip(self.least)

    def checked(self, variances: Array) -> Array:
        """Return variances, in their place the known ones, and none too small to compute with."""
        return np.where(self.is_known, self.known_variances, variances).clip(self.least)

    def slopes(self, path: Path) -> tuple[Array, Array]:
        """Return slopes of f_p in states and parameters, ``(d + p) x N x d``, and where it jumps.

        Differences across a jump, as of ``sign(x)``, are no slopes: the one on the path's side of
        it is.
        """
        d, p = self.d, self.num_parameters
        x = path.states[self.now]
        sizes = _STEP * np.concatenate([self.spread, np.ones(p)])
        dx, dtheta = np.split(np.diag(sizes), [d], axis=1)
        ahead = self.follow(self.now, x + dx[:, None], path.parameters + dtheta)
        behind = self.follow(self.now, x - dx[:, None], path.parameters - dtheta)
        slopes = (ahead - behind) / (2 * sizes)[:, None, None]
        after = ahead - path.following
        before = path.following - behind
        is_jump = (np.abs(after - before) > _JUMP * _STEP * self.spread).any(-1)
        lesser = np.where(np.abs(after) < np.abs(before), after, before)
        slopes = np.where(is_jump[..., None], lesser / sizes[:, None, None], slopes)
        return slopes, is_jump

    def linearised(self, path: Path) -> list[Link]:
        """Linearise the chain near a path: z[t + 1] = F[t] z[t] + b[t] with z = (x, theta)."""
        d, p = self.d, self.num_parameters
        x = path.states[self.now]
        slopes, _ = self.slopes(path)
        F = np.tile(np.eye(d + p), (len(x), 1, 1))
        F[:, :d] = np.moveaxis(np.nan_to_num(slopes), 0, -1)  # 0 where f_p fails nearby
        z = np.hstack([x, np.tile(path.parameters, (len(x), 1))])
        b = np.zeros_like(z)
        b[:, :d] = path.following - np.einsum("tij,tj->ti", F[:, :d], z)
        cuts = (self.lengths - 1).cumsum()[:-1]
        links = []
        parts = zip(self.stretches, np.split(F, cuts), np.split(b, cuts), strict=True)
        for rows, matrices, offsets in parts:
            y = path.measured[rows]
            H = np.tile(np.eye(d, d + p), (len(y), 1, 1))
            if self.sensing is not None:
                H, y = self.sensing.linearised(path.states[rows], path.parameters, y)
            links.append(Link(matrices, offsets, H, y))
        return links

    def towards(self, path: Path, estimate: Estimate) -> tuple[Path, float]:
        """Go to the estimate, or as much of the way as explains more; return the share, maybe 0."""
        ahead, theta = estimate.states[:, : self.d], estimate.states[0, self.d :]
        before = self.cost(path, estimate.variances)
        share = 1.0
        for _ in range(_HALVINGS):
            states = path.states + share * (ahead - path.states)
            parameters = path.parameters + share * (theta - path.parameters)
            following = self.follow(self.now, states[self.now], parameters)
            other = Path(states, path.measured, parameters, following)
            cost = self.cost(other, estimate.variances)
            if cost <= before + _BETTER:  # false of NaN
                return other, share
            share /= 2
        return path, 0.0

    def likely_variances(self, links: Sequence[Link], smoothed: Sequence[Smoothed]) -> Array:
        """Return variances of both noises, most likely given the states' distribution."""
        measured, added = kalman.expected_squares(links, smoothed, self.d)
        noise = _means(measured, otherwise=self.spread**2)  # of hidden states any number
        return np.stack([noise, added.mean(0)])

    def cost(self, path: Path, variances: Array) -> float:
        """Return twice the negative log density of a path, up to a constant; NaN if f_p fails."""
        noise, process_noise = variances
        outputs = self.outputs(path.states, path.parameters)
        errors = np.nansum((path.measured - outputs) ** 2 / noise)
        added = (path.states[self.now + 1] - path.following) ** 2 / process_noise
        begins = (path.states[self.firsts] - self.first) ** 2 / self.first_variance
        return float(errors + added.sum() + begins.sum() + (path.parameters**2).sum())

    def _defined(self, rows: Array, states: Array, parameters: Array) -> Array:
        """Return next states by f_p, ``n x d``; raise an error where it fails."""
        following = self.follow(rows, states, parameters)
        failed = np.flatnonzero(~np.isfinite(following).all(1))
        if len(failed):
            action = self.recorded[rows[failed[0]], self.spec.state_dim :].tolist()
            raise PhysicsError(
                f"Physics {self.physics.name!r} fails at {len(failed)} of {len(states)} states "
                f"where smoothing begins, first {states[failed[0]].tolist()} under the action "
                f"{action}. They were measured with noise, or guesses lead there from `start`: "
                "let the physics be smooth beyond its limits, or give another start."
            )
        return following

    def follow(self, rows: Array, states: Array, parameters: Array) -> Array:
        """Return next states ``... x n x d``, NaN where f_p fails, angles near those of ``states``.

        Rows ``n`` have the actions, and the states that do not move, which f_p reads.
        """
        inputs = self.recorded[rows].expand(*states.shape[:-1], -1).clone()
        following = torch.from_numpy(np.ascontiguousarray(states))
        values = None
        unknowns = self.physics.unknowns
        if unknowns:
            values = unknowns.to_values(torch.from_numpy(parameters)[..., : len(unknowns)])
        for actions in self.within[rows].unbind(1):
            inputs[..., self.spec.moving] = following
            inputs[..., self.spec.state_dim :] = actions
            following = self.physics.or_nan(inputs[..., self.spec.physics_columns], values)
            check_next_values(self.physics, following, states.shape[-1])
        return self.near(following.numpy(), states)

    def near(self, states: Array, others: Array) -> Array:
        """Return states ``... x d``, their angles within half a turn of those of others."""
        near = states.copy()
        turns = np.round((states - others)[..., self.angles] / (2 * np.pi))
        near[..., self.angles] -= 2 * np.pi * turns
        return near


def chain_of(
    records: Records,
    physics: Physics | Callable[[Tensor], Tensor],
    step: float | None,
    start: Mapping[str, tuple[float, float]] | None,
    noise: Tensor | None = None,
    process_noise: Tensor | None = None,
    sensors: Sensors | None = None,
) -> Chain:
    """Return the chain of all stretches of records; arguments are those of :func:`smooth`."""
    check_kind("sensors", sensors, Sensors | None, 'such as Sensors(["x"], offset={...})')
    steps = with_known_inputs(control_steps(records, step))
    spec = records.spec
    length = steps.records[0].sampling_step
    f_p = one_physics(physics, spec, "take one of them")
    substeps = substeps_of(f_p, steps, length)
    noises = {"noise": noise, "process_noise": process_noise}
    variances = np.stack([_variances(sd, name, spec) for name, sd in noises.items()])
    return Chain(f_p, steps, variances, first_moments(start, spec), substeps, sensors)


def substeps_of(f_p: Physics, steps: Records, length: float) -> int:
    """Return how many steps of the physics make a control step: 1, or as many as it has samples."""
    if f_p.step is None or abs(f_p.step - length) <= _SAME * length:
        return 1
    spec = steps.spec
    samples = steps.records[0].within.shape[1]
    if len(spec.moving) == spec.state_dim and abs(f_p.step * samples - length) <= _SAME * length:
        return samples
    raise ValueError(
        f"Physics {f_p.name!r} makes steps of {f_p.step:g}, but the control step of the "
        f"records is {length:g}; pass step={f_p.step:g}, or build it with step={length:g}, or, for "
        f"states that all move, with the step of the samples, {length / samples:g}."
    )


def with_known_inputs(steps: Records) -> Records:
    """Return stretches from where all inputs of the physics that do not move are known."""
    spec = steps.spec
    records = []
    beside = [i for i in spec.physics_columns if i < spec.state_dim and i not in spec.moving]
    names = [spec.states[i] for i in beside]
    for name in names:
        origin = name
        while origin in spec.previous:
            origin = spec.previous[origin]
        if origin != name and origin in spec.states:
            raise ValueError(
                f"The physics reads {name!r}, an earlier value of the state {origin!r}, but "
                "`smooth` takes earlier actions only."
            )
    for record in steps:
        unknown = record.states[:-1, beside].isnan().any(1).nonzero().flatten().tolist()
        first = max(unknown, default=-1) + 1
        if first < len(record.times) - 1:
            records.append(record.part(slice(first, None)))
    if not records:
        raise ValueError(
            f"Expected stretches with all of {', '.join(names)}, which the physics reads."
        )
    return Records(records, spec)


def first_moments(start: Mapping[str, tuple[float, float]] | None, spec: StateSpec) -> Array:
    """Return means and standard deviations, ``2 x d``, of first states; NaN if they are unknown."""
    names = [spec.states[i] for i in spec.moving]
    start = {} if start is None else start
    example = f"a dictionary, such as {{{names[0]!r}: (0.0, 1.0)}}: mean and standard deviation"
    check_kind("start", start, Mapping, example)
    moments = np.full((2, len(names)), math.nan)
    for name, pair in start.items():
        if name not in names:
            raise ValueError(f"start: there is no {name!r} among the states that move, {names}.")
        numbers = finite_array(pair, (2,))
        if numbers is None or numbers[1] <= 0:
            raise ValueError(
                f"start: expected mean and standard deviation of {name!r}, the latter above 0, got "
                f"{pair!r}."
            )
        moments[:, names.index(name)] = numbers
    return moments


def _variances(sd: Tensor | None, name: str, spec: StateSpec) -> Array:
    """Return variances of the states that move, NaN where they are to be learnt."""
    if sd is None:
        sd = torch.full((spec.state_dim,), math.nan, dtype=torch.float64)
    sd = of_states(sd, name, (spec.state_dim,))
    if (sd <= 0).any() or sd.isinf().any():
        raise ValueError(
            f"Expected {name} as standard deviations above 0, or NaN for those to be learnt, got "
            f"{sd.tolist()}."
        )
    variances: Array = sd[spec.moving].square().numpy()
    return variances


def _means(values: Array, otherwise: Array | float) -> Array:
    """Return means of the numbers of each column, or ``otherwise`` if it has none."""
    columns = np.ascontiguousarray(values.T)
    number = (~np.isnan(columns)).sum(1)
    return np.where(number > 0, np.nansum(columns, 1) / number.clip(1), otherwise)
