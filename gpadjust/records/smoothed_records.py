"""States of a machine while it was recorded, from noisy and incomplete records."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.dynamics.particles import even_normal, of_states
from gpadjust.dynamics.targets import one_physics
from gpadjust.physics import ODEPhysics, Physics
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.records.chain import Chain, Known
from gpadjust.records.kalman import Array, draw_paths
from gpadjust.records.record import Record, Stretch, in_control_steps
from gpadjust.records.records import Records
from gpadjust.records.smoothing import Estimate, estimate, variation
from gpadjust.states import StateSpec

_DRAWS = 256  # of the parameters
_SAME = 0.01  # of a step, by which another one may differ from it


@dataclass(frozen=True, repr=False, eq=False)
class SmoothedRecords:
    r"""The states of a machine while it was recorded, as :func:`smooth` finds them.

    Attributes:
        records: The most likely states, at the control steps.
        sd: Their standard deviations, ``N x state_dim`` of each record; 0 of states that the
            physics does not move.
        noise: Standard deviations of the errors of what was measured, ``state_dim``; NaN of a state
            that never was, 0 of those that the physics does not move.
        process_noise: Standard deviations of what a step adds to the physics, ``state_dim``.
        log_density: Of what was measured, near these states.
    """

    records: Records
    sd: tuple[Tensor, ...]
    noise: Tensor
    process_noise: Tensor
    log_density: float
    _chain: Chain
    _found: Estimate

    @property
    def physics_parameters(self) -> PhysicsParameters:
        """The posterior of the unknown parameters of the physics; empty if it has none."""
        unknowns, last = self._chain.physics.unknowns, self._found.stretches[0].states
        if not unknowns:
            return PhysicsParameters({}, [])
        p = len(unknowns)
        mean, covariance = (torch.from_numpy(part[0, ..., -p:].copy()) for part in last)
        values, vectors = torch.linalg.eigh(covariance[-p:])
        spread = even_normal(_DRAWS, p, seed=0) * values.clamp_min(0).sqrt()
        return PhysicsParameters(unknowns, unknowns.at(mean + spread @ vectors.mT).unbind(-1))

    @cached_property
    def variation(self) -> Tensor:
        """Variation of the parameters from one stretch of the records to another, ``p``.

        Standard deviations, in those of each parameter's prior: with 0.1, and a prior of a factor
        of 1.5, by some 4 %. Stretches of which each has parameters of its own are explained by
        these best, given the noises; where they tell nothing, 0.05. No equation is right in all:
        what it lacks shows as parameters that vary, and moves a free run for as long as that lasts,
        where process noise averages out. :meth:`Dynamics.free_run` takes it. Records of one machine
        and day tell nothing of another's.

        Raises:
            ValueError: If the physics has no unknown parameters.
        """
        if not self._chain.physics.unknowns:
            raise ValueError("Expected a physics with unknown parameters; found none, that vary.")
        return variation(self._chain, self._found)

    def draw(self, seed: int = 0) -> Records:
        """States drawn from their posterior, along each record.

        Unlike the most likely ones they scatter about the physics as the machine does, so that a
        model which learns from them finds the right noise.

        Args:
            seed: Seed of the draw.

        Raises:
            ValueError: If it is no whole number of 0 or more.
        """
        rng = np.random.default_rng(checked_whole("seed", seed, 0))
        paths = draw_paths(self._found.stretches, self._chain.num_parameters, rng)
        return _records(self.records, self._chain.stretches, paths)

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
    num_starts: int | None = None,
    max_rounds: int = 100,
    progress: bool = False,
) -> SmoothedRecords:
    r"""Estimate the states of a machine, measured with noise or not at all, along its records.

    The records are taken for

    .. math:: x_{t+1} = f_p(x_t, u_t; \theta) + q_t, \quad y_t = x_t + e_t, \quad
              q_t \sim N(0, Q), \quad e_t \sim N(0, R)

    with diagonal R, the noise, and Q, the process noise, which has all that f_p does not know.
    States x, unknown parameters :math:`\theta` of the physics, R and Q are estimated together, by
    an iterated extended Kalman smoother and expectation maximisation. Where Q turns out small this
    fits f_p to free runs, as shooting methods do; where it is large, to single steps, but not
    from noisy states (errors in variables). Look at the noise that is found: a physics that is
    wrong beyond its parameters takes for noise what it does not follow, and pulls states to itself.

    Args:
        records: The records. A state that is NaN throughout is hidden.
        physics: The next values of the states that are neither exogenous nor previous actions,
            from these and the actions, as of :class:`LearnedDynamics`; its unknown parameters are
            learnt from all records together.
        step: The control step, as of :meth:`Records.trajectories`.
        start: Of states by name, mean and standard deviation at the beginning of each stretch;
            needed of hidden ones. Default: about the first that was measured.
        noise: Standard deviations ``state_dim`` of the errors of what was measured; NaN for those
            to be learnt. Default: all.
        process_noise: The same of what a step adds to f_p. Learnt, it makes the best predictions of
            the next measurement; said to be small, it fits f_p to long free runs, to which errors
            that persist, as of a wrong f_p, would otherwise be noise.
        num_starts: How many starts to take the best end of, if there is something to learn of
            the physics. Default: 4 with hidden states, else 1.
        max_rounds: The most rounds of smoothing of each. With hidden states all of them may be
            needed: 4 starts of 100 rounds, half a minute for 300 rows and a physics of formulas.
        progress: Whether to show a progress bar.

    Returns:
        The states, their uncertainty, and what decided them.

    Raises:
        TypeError: If an argument is of the wrong type.
        ValueError: If a hidden state has no start, names or numbers are wrong, or as
            :meth:`Records.trajectories`.
        PhysicsError: If the physics fails at measured states.
        RuntimeError: If the states diverge from all starts.

    Warns:
        SmoothingWarning: If the states did not settle.

    Example:
        A mass on a spring of unknown stiffness, of which only the position is measured:

        >>> import torch
        >>> from gpadjust.records import Record, Records, smooth
        >>> from gpadjust.physics import ODEPhysics, Unknown
        >>> from gpadjust.states import StateSpec
        >>> def spring(x, u, p):
        ...     return torch.stack([x[:, 1], u[:, 0] - p.stiffness * x[:, 0]], dim=-1)
        >>> unknowns = {"stiffness": Unknown(1.0, factor=2.0)}
        >>> physics = ODEPhysics(spring, step=0.1, state_dim=2, unknowns=unknowns)
        >>> t = 0.1 * torch.arange(50, dtype=torch.float64)
        >>> position = (1.5 * t).cos() + 0.01 * torch.randn(50, dtype=torch.float64)
        >>> states = torch.stack([position, torch.full_like(t, torch.nan)], dim=-1)
        >>> spec = StateSpec(["x", "v"], ["u"])
        >>> records = Records(Record(t, states, torch.zeros_like(states[:, :1])), spec)
        >>> found = smooth(records, physics, start={"v": (0.0, 1.0)})
        >>> bool((found.physics_parameters.mean - 2.25).abs() < 0.05)
        True
    """
    if not isinstance(records, Records):
        raise TypeError(f"Expected records as Records([record, ...], spec), found {records!r}.")
    spec = records.spec
    checked_whole("max_rounds", max_rounds, 1)
    stretches = in_control_steps(records.records, spec, step)
    if short := sum(not len(stretch.actions) for stretch in stretches):
        warnings.warn(
            f"Left out: {short} of {len(stretches)} stretches, shorter than a step.",
            UserWarning,
            stacklevel=2,
        )
        stretches = [stretch for stretch in stretches if len(stretch.actions)]
    stretches = _known_inputs(stretches, spec)
    whole = _checked_physics(physics, records, stretches[0])
    variances = _variances(noise, "noise", spec), _variances(process_noise, "process_noise", spec)
    known = Known(*variances, _starts(start, spec))
    hidden = _hidden(stretches, known, spec)
    if num_starts is None:
        num_starts = 4 if hidden and whole.unknowns else 1
    checked_whole("num_starts", num_starts, 1)
    chain = Chain(whole, spec, stretches, known)
    found = estimate(chain, max_rounds, num_starts, progress)
    squares = [np.diagonal(s.covariances, axis1=1, axis2=2) for s, _ in found.stretches]
    still = [each._replace(states=torch.zeros_like(each.states)) for each in stretches]
    sd = _by_record(records, still, [np.sqrt(v.clip(0)) for v in squares], remember=False)
    sizes = torch.zeros(2, spec.state_dim, dtype=torch.float64)
    sizes[:, spec.moving] = torch.from_numpy(np.sqrt([found.noise, found.process_noise]))
    sizes[0, hidden] = torch.nan
    return SmoothedRecords(
        _records(records, stretches, [s.means for s, _ in found.stretches]),
        tuple(sd.values()),
        sizes[0],
        sizes[1],
        found.log_density,
        chain,
        found,
    )


def _records(records: Records, stretches: Sequence[Stretch], paths: Sequence[Array]) -> Records:
    """Records whose states that move are those of the paths, ``T + 1 x (d + p)``."""
    states, found = _by_record(records, stretches, paths, remember=True), []
    for number, own in states.items():
        mine = [stretch for stretch in stretches if stretch.record == number]
        # The action of the last row of a stretch counts for nothing.
        actions = [torch.cat([stretch.actions, stretch.actions[-1:]]) for stretch in mine]
        labels = [i for i, stretch in enumerate(mine) for _ in stretch.times]
        times = torch.cat([stretch.times for stretch in mine])
        found.append(Record(times, own, torch.cat(actions), labels, records.records[number].name))
    return Records(found, records.spec)


def _by_record(
    records: Records, stretches: Sequence[Stretch], paths: Sequence[Array], *, remember: bool
) -> dict[int, Tensor]:
    """States by the number of the record, those that move from the paths, lags filled in."""
    spec, found = records.spec, dict[int, list[Tensor]]()
    for stretch, path in zip(stretches, paths, strict=True):
        states = stretch.states.clone()
        states[:, spec.moving] = torch.from_numpy(path[:, : len(spec.moving)].copy())
        for _ in spec.previous if remember else ():  # as often as the longest chain of them needs
            spec.remember(states[1:], states[:-1].clone(), stretch.actions)
        found.setdefault(stretch.record, []).append(states)
    return {number: torch.cat(parts) for number, parts in found.items()}


def _checked_physics(
    physics: Physics | Callable[[Tensor], Tensor], records: Records, stretch: Stretch
) -> Physics:
    """One physics of next states, of the control step of a stretch."""
    whole = one_physics(physics, records.spec, "smooth by one of them")
    found = float(stretch.times[1] - stretch.times[0])
    if isinstance(whole, ODEPhysics) and abs(whole.step - found) > _SAME * found:
        raise ValueError(
            f"Physics {whole.name!r} makes steps of {whole.step:g}, but the control step of the "
            f"records is {found:g}; pass step={whole.step:g}, or build it with step={found:g}."
        )
    return whole


def _known_inputs(stretches: Sequence[Stretch], spec: StateSpec) -> list[Stretch]:
    """Stretches from where all is known that the physics reads beside the states that move."""
    beside = [i for i in spec.physics_columns if i < spec.state_dim and i not in spec.moving]
    for name in (spec.states[i] for i in beside):
        held = name
        while held in spec.previous:
            held = spec.previous[held]
        if held != name and held in spec.states:
            raise ValueError(
                f"The physics reads {name!r}, an earlier value of the state {held!r}, which smooth "
                "would have to find, too; it takes earlier actions only."
            )
    found = []
    for stretch in stretches:
        gap = stretch.states[:-1, beside].isnan().any(1)
        first = int(gap.nonzero().max()) + 1 if gap.any() else 0
        if first < len(stretch.actions):
            parts = {
                name: getattr(stretch, name)[first:] for name in ("states", "actions", "times")
            }
            found.append(stretch._replace(**parts))
    if not found:
        names = ", ".join(spec.states[i] for i in beside)
        raise ValueError(f"Expected stretches with all of {names}, which the physics reads.")
    return found


def _variances(given: Tensor | None, name: str, spec: StateSpec) -> Array:
    """Variances of the states that move, NaN where they are to be learnt."""
    sd = torch.full((spec.state_dim,), math.nan, dtype=torch.float64)
    if given is not None:
        sd = of_states(given, name, (spec.state_dim,))
    if (sd <= 0).any() or sd.isinf().any():
        raise ValueError(
            f"Expected {name} as standard deviations above 0, or NaN for those to be learnt, got "
            f"{sd.tolist()}."
        )
    found: Array = sd[spec.moving].square().numpy()
    return found


def _starts(
    given: Mapping[str, tuple[float, float]] | None, spec: StateSpec
) -> dict[int, tuple[float, float]]:
    """Prior knowledge of the first states, by their number among those that move."""
    if given is not None and not isinstance(given, Mapping):
        raise TypeError(
            f"Expected start as a dictionary, such as {{{spec.states[0]!r}: (0.0, 1.0)}}: mean and "
            f"standard deviation, got {given!r}."
        )
    found, names = {}, [spec.states[i] for i in spec.moving]
    for name, pair in (given or {}).items():
        if name not in names:
            raise ValueError(f"start: there is no {name!r} among the states that move, {names}.")
        numbers = isinstance(pair, Sequence) and all(isinstance(x, Real) for x in pair)
        if not numbers or len(pair) != 2 or not -math.inf < pair[0] < math.inf > pair[1] > 0:
            raise ValueError(
                f"start: expected mean and standard deviation of {name!r}, the latter above 0, got "
                f"{pair!r}."
            )
        found[names.index(name)] = (float(pair[0]), float(pair[1]))
    return found


def _hidden(stretches: Sequence[Stretch], known: Known, spec: StateSpec) -> list[int]:
    """The states that were never measured; a ValueError if they are all, or have no start."""
    names = [spec.states[i] for i in spec.moving]
    measured = torch.cat([~stretch.states[:, spec.moving].isnan() for stretch in stretches])
    if not measured.any():
        raise ValueError(f"Expected measured states, found none of {', '.join(names)}.")
    hidden: list[int] = (~measured.any(0)).nonzero().flatten().tolist()
    for i in hidden:
        if i not in known.start:
            raise ValueError(
                f"State {names[i]!r} was never measured; say where it may be at the beginning of a "
                f"stretch, such as start={{{names[i]!r}: (0.0, 1.0)}}: mean and standard deviation."
            )
    return [spec.moving[i] for i in hidden]
