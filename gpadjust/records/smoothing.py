"""The states of a machine, from noisy and incomplete records and a physics.

From top to bottom: :func:`smooth`, and the search for the most likely states, parameters and
noises. The chain of states is in :mod:`gpadjust.records.chain`, its moments are from
:mod:`gpadjust.records.kalman`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import checked_whole, warn
from gpadjust.dynamics.least_squares import even_normal
from gpadjust.physics import Physics, PhysicsError
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.physics.unknown import Unknowns
from gpadjust.progress import long_work, tick
from gpadjust.records import kalman
from gpadjust.records.chain import Chain, Estimate, chain_of
from gpadjust.records.kalman import Array
from gpadjust.records.records import Record, Records, remember
from gpadjust.records.variation import variation_of
from gpadjust.states import Sensors, StateSpec

_DRAWS = 256  # of the parameters
_NEARER = math.log(4)  # the most that a logarithm of a variance changes in a round
_ARRIVED = 0.01  # nats of the log density
_STILL = 0.1  # nats, a change that is not settled
_LIKELY = 3.0  # nats, below which another end is about as likely
_APART = 4.0  # standard deviations of the parameters between ends
_RIGHT = 0.01  # standard deviations of the states, by which one may be off for good


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
        rival: Parameters ``p`` at which another start ended that is about as likely; None without.
    """

    records: Records
    sd: tuple[Tensor, ...]
    noise: Tensor
    process_noise: Tensor
    log_density: float
    is_settled: bool
    chain: Chain
    estimate: Estimate
    rival: Tensor | None = None

    @property
    def parameters(self) -> PhysicsParameters:
        """The posterior of the unknown parameters of physics and sensors; empty if there are none.

        Parameters of sensors are ``x_gain``, ``x_offset`` and ``x_delay``, for a state x.
        """
        moments = self.estimate.of_parameters(self.chain.d)
        return drawn_parameters(self.chain.unknowns, *moments)

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

    @cached_property
    def jumps(self) -> float:
        """The share of steps near which the physics jumps, as ``sign(x)`` does at 0."""
        _, is_jump = self.chain.slopes(self.chain.path_of(self.estimate))
        return float(is_jump.any(0).mean())

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
    estimate, is_settled, rival = _estimate(chain, max_rounds, num_starts)
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
        rival,
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


def _estimate(
    chain: Chain, max_rounds: int, num_starts: int
) -> tuple[Estimate, bool, Tensor | None]:
    """Find the most likely states, parameters and variances, if the search settled, and a rival."""
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
    settled = [estimate for estimate, gained in arrived if abs(gained) <= _STILL]
    return best, is_settled, _rival(chain, best, settled)


def _rival(chain: Chain, best: Estimate, ends: Sequence[Estimate]) -> Tensor | None:
    """Return parameters at the likeliest end that is apart from the best, and not unlikelier."""
    mean, covariance = best.of_parameters(chain.d)
    for end in sorted(ends, key=lambda end: -end.log_density):
        off = end.states[0, chain.d :] - mean
        # (theta' - theta)' C^-1 (theta' - theta)
        square = off @ np.linalg.solve(covariance, off)
        if best.log_density - end.log_density < _LIKELY and square > _APART**2:
            return chain.unknowns.to_values(torch.from_numpy(end.states[0, chain.d :].copy()))
    return None


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
