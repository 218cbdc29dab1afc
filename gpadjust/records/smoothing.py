"""The states of a machine, from noisy and incomplete records and a physics.

From top to bottom: :func:`smooth`; the search for the most likely states, parameters and noises;
the chain of Gaussian states that the physics makes near a path. Moments of a chain are from
:mod:`gpadjust.records.kalman`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import check_kind, checked_whole, finite_array, warn
from gpadjust.dynamics.base import of_states
from gpadjust.dynamics.least_squares import even_normal
from gpadjust.dynamics.physics_dynamics import check_next_values, one_physics
from gpadjust.physics import Physics, PhysicsError
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.physics.unknown import Unknowns
from gpadjust.progress import long_work, tick
from gpadjust.records import kalman
from gpadjust.records.kalman import Array, Link, Smoothed
from gpadjust.records.records import Record, Records, control_steps, remember
from gpadjust.records.sensing import Sensing
from gpadjust.records.variation import variation_of
from gpadjust.states import Sensors, StateSpec
from gpadjust.states.state_spec import side_by_side

_DRAWS = 256  # of the parameters
_SAME = 0.01  # of a step, by which another one may differ from it
_NEARER = math.log(4)  # the most that a logarithm of a variance changes in a round
_ARRIVED = 0.01  # nats of the log density
_STILL = 0.1  # nats, a change that is not settled
_RIGHT = 0.01  # standard deviations of the states, by which one may be off for good
_STEP = 1e-4  # of differences, in standard deviations of a parameter or a state
_WIDE = 10.0  # standard deviations of a state, by which the first one may be elsewhere
_SIZE = 1e-3  # of a state's size: it varies by no less
_SHARE = 0.25  # of the variance of f_p's errors in single steps: that of the noise at first
_HIDDEN = 0.1  # of the change in a step: what it adds to a state that is never measured, at first
_LEAST = 1e-6  # of the standard deviation of a state: the least noise
_HALVINGS = 6
_BETTER = 0.01  # what a worse path may cost more, by rounding


class SmoothingWarning(UserWarning):
    """The states of a record did not settle."""


@dataclass(frozen=True, repr=False, eq=False)
class SmoothedRecords:
    r"""The states of a machine while it was recorded, as :func:`smooth` estimates them.

    Attributes:
        records: The most likely states at the control steps, a record for each stretch.
        sd: Their standard deviations, ``N x state_dim`` of each record; 0 of states that the
            physics does not move.
        noise: Standard deviations of the measurements' errors, ``state_dim``; NaN of hidden states,
            0 of those that the physics does not move.
        process_noise: Standard deviations of what a step adds to the physics, ``state_dim``.
        log_density: Of the measurements, near these states.
        is_settled: Whether the search ended; if not, there was a SmoothingWarning.
        chain: The records as a chain of states, which the physics leads through.
        estimate: Moments of the chain's states, which have the parameters at their end.
    """

    records: Records
    sd: tuple[Tensor, ...]
    noise: Tensor
    process_noise: Tensor
    log_density: float
    is_settled: bool
    chain: Chain
    estimate: Estimate

    @property
    def parameters(self) -> PhysicsParameters:
        """The posterior of the unknown parameters of physics and sensors; empty if there are none.

        Parameters of sensors are ``x_gain``, ``x_offset`` and ``x_delay``, for a state x.
        """
        moments = self.estimate.stretches[0].states
        theta = slice(self.chain.d, None)
        mean, covariance = moments.means[0, theta], moments.covariances[0, theta, theta]
        return drawn_parameters(self.chain.unknowns, mean, covariance)

    @property
    def physics_parameters(self) -> PhysicsParameters:
        """The posterior of the unknown parameters of the physics; empty if it has none."""
        unknowns = self.chain.physics.unknowns
        draws = self.parameters.draws[:, : len(unknowns)]
        return PhysicsParameters(unknowns, [*draws.unbind(-1)])

    def corrected(self, states: Tensor) -> Tensor:
        """Correct measured states of a stretch, ``N x state_dim``, by the center of the sensors.

        Of a sensor with a delay they are interpolated, and NaN at the end.
        """
        chain = self.chain
        corrected = states.clone()
        measured = states[:, chain.spec.moving].numpy()
        theta = self.estimate.states[0, chain.d :]
        if chain.sensing is not None:
            shown = chain.sensing.corrected(measured, theta, [slice(0, len(states))])
            corrected[:, chain.spec.moving] = torch.from_numpy(shown)
        return corrected

    @cached_property
    def variation(self) -> Tensor:
        """Variation of the parameters from one stretch of the records to another, ``p``.

        Standard deviations, in those of each parameter's prior: with 0.1, and a prior of a factor
        of 1.5, some 4 %. They explain best, given the noises, stretches that each have other
        parameters; where the stretches do not tell, they are 0.05. A fault of an equation shows as
        parameters that vary, and moves a free run for as long as it lasts, where process noise
        averages out: see ``variation`` of :meth:`Dynamics.free_run`.

        Raises:
            ValueError: If the physics has no unknown parameters, or sensors have some.
        """
        if not self.chain.physics.unknowns or self.chain.sensing is not None:
            raise ValueError(
                "Expected a physics with unknown parameters, and sensors without; found "
                f"{', '.join(self.chain.unknowns) or 'no unknown parameters'}."
            )
        chain = self.chain
        path = chain.path_of(self.estimate)
        variances = self.estimate.variances
        return variation_of(chain.linearised(path), chain.starts, path.parameters, variances)

    def draw(self, seed: int = 0) -> Records:
        """Draw states from their posterior, along each record.

        Unlike the most likely ones they scatter about the physics as the machine does, so that a
        model which learns from them finds the right noise.
        """
        rng = np.random.default_rng(checked_whole("seed", seed, 0))
        paths = kalman.draw_paths(self.estimate.stretches, self.chain.num_parameters, rng)
        return _with_states(self.records, np.concatenate(paths))

    def __repr__(self) -> str:
        """Names, noise and process noise."""
        spec = self.records.spec
        rows = zip(spec.states, self.noise.tolist(), self.process_noise.tolist(), strict=True)
        lines = [f"{name}: noise {e:.3g}, process noise {q:.3g}" for name, e, q in rows]
        return "\n".join([f"SmoothedRecords of {len(self.records)}", *lines])


def smooth(
    records: Records,
    physics: Physics | Callable[[Tensor], Tensor],
    step: float | None = None,
    *,
    start: Mapping[str, tuple[float, float]] | None = None,
    noise: Tensor | None = None,
    process_noise: Tensor | None = None,
    sensors: Sensors | None = None,
    num_starts: int | None = None,
    max_rounds: int = 100,
) -> SmoothedRecords:
    r"""Estimate the states of a machine, measured with noise or not at all, along its records.

    The records are taken for

    .. math:: x_{t+1} = f_p(x_t, u_t; \theta) + q_t, \quad y_t = x_t + e_t, \quad
              q_t \sim N(0, Q), \quad e_t \sim N(0, R)

    with diagonal R, the noise, and Q, the process noise, which has all that f_p lacks. States x,
    unknown parameters :math:`\theta` of the physics, R and Q are estimated together, by an iterated
    extended Kalman smoother and a quasi-Newton method. Where Q turns out small this fits f_p to
    free runs, as shooting methods do; where it is large, to single steps.

    Args:
        records: The records. A state that is NaN throughout is hidden.
        physics: The next values of the states that are neither exogenous nor previous actions,
            from these and the actions, as of :class:`LearnedDynamics`.
        step: The control step, as of :meth:`Records.trajectories`. If it has several samples, a
            physics whose step is that of the samples follows the action of each; any other one is
            given their mean.
        start: Of states by name, mean and standard deviation at the beginning of each stretch;
            needed of hidden ones. Default: about the first that was measured.
        noise: Standard deviations ``state_dim`` of the measurements' errors; NaN for those to be
            learnt. Default: all.
        process_noise: The same of what a step adds to f_p. Learnt, it makes the best predictions of
            the next measurement; a small one fits f_p to long free runs.
        sensors: Sensors of states, with unknown gains, offsets and delays. Measurements begin later
            by the longest delay that is likely; the errors of the measurements above are in the
            unit of the sensor, those found in that of the state.
        num_starts: How many starts to take the best end of. Default: 4 with hidden states and
            unknown parameters, 8 with sensors, else 1.
        max_rounds: The most rounds of smoothing of each; most settle in 15 to 40.

    Raises:
        TypeError: If an argument is of the wrong type.
        ValueError: If a hidden state has no start, names or numbers are wrong, or as
            :meth:`Records.trajectories`, as are the warnings.
        PhysicsError: If the physics fails at measured states.
        RuntimeError: If the states diverge from all starts.

    Warns:
        SmoothingWarning: If the states did not settle.

    Example:
        A mass on a spring of unknown stiffness, of which only the position is measured:

        >>> import torch
        >>> from gpadjust import FormulaPhysics, ODEPhysics, Unknown
        >>> from gpadjust.records import Record, Records, smooth
        >>> from gpadjust.states import StateSpec
        >>> unknowns = {"k": Unknown(1.0, factor=2.0)}
        >>> spring = FormulaPhysics("v, u - k * x", ["x", "v", "u"], unknowns=unknowns)
        >>> t = 0.1 * torch.arange(50, dtype=torch.float64)
        >>> position = (1.5 * t).cos() + 0.01 * torch.randn(50, dtype=torch.float64)
        >>> states = torch.stack([position, torch.full_like(t, torch.nan)], dim=-1)
        >>> record = Record(t, states, torch.zeros_like(states[:, :1]))
        >>> records = Records(record, StateSpec(["x", "v"], ["u"]))
        >>> smoothed = smooth(records, ODEPhysics(spring, 0.1, 2), start={"v": (0.0, 1.0)})
        >>> bool((smoothed.physics_parameters.mean - 2.25).abs() < 0.05)
        True
    """
    checked_whole("max_rounds", max_rounds, 1)
    chain = chain_of(records, physics, step, start, noise, process_noise, sensors)
    if num_starts is None:
        num_starts = 1
        if sensors is not None:
            num_starts = 8
        elif chain.hidden.any() and chain.unknowns:
            num_starts = 4
    checked_whole("num_starts", num_starts, 1)
    estimate, is_settled = _estimate(chain, max_rounds, num_starts)
    covariances = np.concatenate([part.states.covariances for part in estimate.stretches])
    sd = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, : chain.d].clip(0))
    noises = np.sqrt(estimate.variances)
    noises[0, chain.hidden] = math.nan
    noises[0] /= chain.gain(estimate.states[0, chain.d :])  # in the unit of the states
    noise, process_noise = _of_all_states(noises, chain.spec)
    return SmoothedRecords(
        _with_states(chain.steps, estimate.states),
        _of_all_states(sd, chain.spec).split(chain.lengths.tolist()),
        noise,
        process_noise,
        estimate.log_density,
        is_settled,
        chain,
        estimate,
    )


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


def drawn_parameters(unknowns: Unknowns, mean: Array, covariance: Array) -> PhysicsParameters:
    """Draw parameters from a normal distribution of their coordinates; none if there are none."""
    if not unknowns:
        return PhysicsParameters({}, [])
    values, vectors = torch.linalg.eigh(torch.from_numpy(covariance.copy()))
    spread = even_normal(_DRAWS, len(unknowns), seed=0) * values.clamp_min(0).sqrt()
    at = unknowns.to_values(torch.from_numpy(mean.copy()) + spread @ vectors.mT)
    return PhysicsParameters(unknowns, at.unbind(-1))


def _of_all_states(moving: Array, spec: StateSpec) -> Tensor:
    """Return rows of all states, from those that the physics moves; 0 of the others."""
    rows = torch.zeros(len(moving), spec.state_dim, dtype=torch.float64)
    rows[:, spec.moving] = torch.from_numpy(moving)
    return rows


def _with_states(steps: Records, path: Array) -> Records:
    """Return records of other states that move, ``M x (d + p)`` one record after the other."""
    records = []
    moving = steps.spec.moving
    parts = torch.from_numpy(path[:, : len(moving)]).split([len(record.times) for record in steps])
    for record, part in zip(steps, parts, strict=True):
        states = record.states.clone()
        states[:, moving] = part
        remember(states, record.actions, steps.spec)
        records.append(Record(record.times, states, record.actions, name=record.name))
    return Records(records, steps.spec)


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


class Estimate(NamedTuple):
    """The states of all stretches, and the variances by which they were found.

    Moments are of ``d`` states and after them the coordinates of the ``p`` unknown parameters.
    """

    stretches: list[Smoothed]
    states: Array  # their means, one stretch after the other, M x (d + p)
    variances: Array  # of noise and process noise, 2 x d
    log_density: float  # of the measurements


def _estimate(chain: Chain, max_rounds: int, num_starts: int) -> tuple[Estimate, bool]:
    """Find the most likely states, parameters and variances, and whether the search settled."""
    ends = list[tuple[Estimate, float]]()
    with long_work("smooth", "rounds", total=num_starts * max_rounds):
        for i, (coordinates, known_at_once) in enumerate(chain.starts_of_search(num_starts)):
            tick("rounds", to=i * max_rounds)  # a search that has settled leaves rounds
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
    # Log densities can be compared once the variances that are known have come down to this.
    arrived = [
        end for end in ends if np.array_equal(end[0].variances, chain.checked(end[0].variances))
    ]
    best, gained = max(arrived or ends, key=lambda end: end[0].log_density)
    is_settled = bool(arrived) and abs(gained) <= _STILL
    if not is_settled:
        warn(
            f"The states did not settle in {max_rounds} rounds. Raise num_starts, give narrower "
            "priors or a start, or check that the physics is defined, and without jumps, near "
            "these states. `smooth` also has max_rounds, noise and process_noise.",
            SmoothingWarning,
        )
    return best, is_settled


def _search(
    chain: Chain, coordinates: Array, known_at_once: bool, max_rounds: int
) -> tuple[Estimate, float]:
    r"""Search from these parameters; the log density still changes by as much as is returned.

    Each round linearises the physics along the trajectories found so far, smooths them (an iterated
    extended Kalman smoother, Bell 1994, with the unknown parameters as constants of the state) and
    climbs in the log variances, by the gradient of the log density of the measurements,

    .. math:: \frac{n}{2} \left(\frac{E[(y_t - x_t)^2]}{R} - 1\right), \quad
              \frac{N}{2} \left(\frac{E[(x_{t+1} - f_p(x_t, u_t; \theta))^2]}{Q} - 1\right),

    of which a step of expectation maximisation (Shumway and Stoffer 1982) is the first.
    A new trajectory that explains less is taken part of the way only.
    """
    path = chain.first_path(coordinates)
    variances = chain.first_variances(path)
    if known_at_once:
        variances = chain.checked(variances)
    climb = _Climb(chain.counts / 2)
    value = -math.inf
    gained = hoped = math.inf
    for _ in range(max_rounds):
        tick("rounds")
        # E: p(x, theta | y) of the chain x[t + 1] = F[t] x[t] + b[t] + q[t], F = df_p / dx
        links = chain.linearised(path)
        smoothed, density = kalman.smooth_chain(links, chain.starts, *variances)
        if not math.isfinite(density):
            raise np.linalg.LinAlgError
        gained = density - value
        value = density
        states = np.concatenate([stretch.states.means for stretch in smoothed])
        estimate = Estimate(smoothed, states, variances, density)
        # x <- x + share (E[x | y] - x), share = 1, 1/2, ... until p(x, theta, y) is no less
        path, share = chain.towards(path, estimate)
        if 0 < share < 1:
            continue
        if max(hoped, abs(gained)) < _ARRIVED:
            off = np.abs(estimate.states[:, : chain.d] - path.states) / chain.spread
            if off.max() >= _RIGHT:
                gained = math.inf
            return estimate, gained
        # log R and log Q climb; known ones go to their values
        ratio = chain.likely_variances(links, smoothed) / variances
        gradient = np.where(chain.is_known, 0.0, chain.counts / 2 * (ratio - 1))
        aim = variances * np.exp(climb.step(np.log(variances), gradient, gained))
        moved = np.log(chain.checked(aim) / variances).clip(-_NEARER, _NEARER)
        variances = variances * np.exp(moved)
        hoped = float((gradient * moved).sum())
        if moved[chain.is_known].any():
            hoped = math.inf
    return estimate, gained


class _Climb:
    """Steps of a quasi-Newton method (BFGS, Nocedal and Wright 2006) up a log density.

    Args:
        curvature: By which the first step divides the gradient.
    """

    def __init__(self, curvature: Array) -> None:
        self.first = np.diag(1 / curvature.ravel().clip(1.0))
        self.inverse = self.first
        self.last: tuple[Array, Array] | None = None

    def step(self, x: Array, gradient: Array, gained: float) -> Array:
        """Return the step from ``x``, to which the last step led, and gained so much."""
        point, g = x.ravel(), gradient.ravel()
        if gained < 0 or self.last is None:
            self.inverse = self.first
        else:
            s = point - self.last[0]
            y = self.last[1] - g
            if s @ y > 0:
                # H <- (I - s y' / s'y) H (I - y s' / s'y) + s s' / s'y
                left = np.eye(len(s)) - np.outer(s, y) / (s @ y)
                self.inverse = left @ self.inverse @ left.T + np.outer(s, s) / (s @ y)
        self.last = point, g
        return (self.inverse @ g).clip(-_NEARER, _NEARER).reshape(x.shape)


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

    def linearised(self, path: Path) -> list[Link]:
        """Linearise the chain near a path: z[t + 1] = F[t] z[t] + b[t] with z = (x, theta)."""
        d, p = self.d, self.num_parameters
        x = path.states[self.now]
        sizes = _STEP * np.concatenate([self.spread, np.ones(p)])
        dx, dtheta = np.split(np.diag(sizes), [d], axis=1)
        ahead = self.follow(self.now, x + dx[:, None], path.parameters + dtheta)
        behind = self.follow(self.now, x - dx[:, None], path.parameters - dtheta)
        slope = (ahead - behind) / (2 * sizes)[:, None, None]
        F = np.tile(np.eye(d + p), (len(x), 1, 1))
        F[:, :d] = np.moveaxis(np.nan_to_num(slope), 0, -1)  # 0 where f_p fails nearby
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


def _means(values: Array, otherwise: Array | float) -> Array:
    """Return means of the numbers of each column, or ``otherwise`` if it has none."""
    columns = np.ascontiguousarray(values.T)
    number = (~np.isnan(columns)).sum(1)
    return np.where(number > 0, np.nansum(columns, 1) / number.clip(1), otherwise)
