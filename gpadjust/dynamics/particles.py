"""Particles: how they move, their noise and parameters, their center, and intervals."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from gpadjust.checks import checked_tensor, checked_whole
from gpadjust.physics import Physics, PhysicsError
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.states import StateSpec

_AT_ONCE = 8  # windows whose particles move together: more leave the cache, at half the speed
_ROUNDING = 1e-9  # of a number of particles
_BEYOND = 2.0  # times as much again, half a range of the actions beyond it
_MOST = 0.5  # standard deviations of a parameter's prior
_END = 8.0  # coordinate, beyond which there is nothing of a prior

Move = Callable[[Tensor, Tensor], Tensor]


def step_or_nan(
    move: Callable[[Tensor, Tensor], Tensor],
    states: Tensor,
    actions: Tensor,
    *,
    some_must_succeed: bool = False,
) -> Tensor:
    """The next states ``N x state_dim``; not finite where the physics fails.

    Raises:
        PhysicsError: If the physics does not say where it fails; or fails everywhere, and
            ``some_must_succeed``.
    """
    states, actions = states.clone(), actions.clone()
    failed = torch.zeros(len(states), dtype=torch.bool)
    while True:
        try:
            following = move(states, actions)
        except PhysicsError as error:
            known = failed.clone()
            failed[list(error.rows)] = True
            if (failed == known).all() or (failed.all() and some_must_succeed):
                raise  # it does not say where, or blames what has another place now
            if failed.all():
                return torch.full_like(states, torch.nan)
            # They are evaluated with the others, at a place where the physics does not fail.
            working = int((~failed).nonzero()[0])
            place = states[working].clone(), actions[working].clone()  # not of what is written
            states[failed], actions[failed] = place
        else:
            is_whole = not failed.any()
            return following if is_whole else following.masked_fill(failed[:, None], torch.nan)


def move_on(
    functions: Move, particles: Tensor, lost: Tensor, actions: Tensor, bounds: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Particles a step later, and which are lost by then; a lost one stays where it was.

    Particles are ``K x w x state_dim``, those lost already ``K x w``, actions ``w x action_dim``,
    and bounds of the states ``2 x state_dim``.
    """

    def move(states: Tensor, actions: Tensor) -> Tensor:
        blocks = (rows.unflatten(0, (len(particles), -1)) for rows in (states, actions))
        parts = zip(*(block.split(_AT_ONCE, dim=1) for block in blocks), strict=True)
        return torch.cat([functions(*part) for part in parts], dim=1).flatten(0, 1)

    actions = actions.expand(len(particles), -1, -1)
    after = step_or_nan(move, particles.flatten(0, 1), actions.flatten(0, 1)).view_as(particles)
    fails = ~after.isfinite().all(-1)
    if bounds is not None:
        fails |= ((after < bounds[0]) | (after > bounds[1])).any(-1)
    lost = lost | fails
    return torch.where(lost.unsqueeze(-1), particles, after), lost


def about_center(spec: StateSpec, particles: Tensor) -> tuple[Tensor, Tensor]:
    """The center ``... x state_dim`` of particles ``K x ... x state_dim``, and how far they are.

    Where angles went round different ways, their center is the mean on the circle, and how far each
    is from it is the shortest way round.
    """
    center = particles.mean(0)
    for i in spec.angle_columns:
        angle = particles[..., i]
        center[..., i] = torch.atan2(angle.sin().mean(0), angle.cos().mean(0))
    return center, spec.change(center.expand_as(particles), particles)


def measurement_noise(
    spec: StateSpec,
    noise: Tensor,
    num_particles: int,
    generator: torch.Generator,
    root: Tensor | None = None,
) -> Tensor:
    """Draws of a noise with standard deviations ``... x state_dim``, one for each particle.

    An integrated state has the draws of its velocity. Predicted states have a correlation, if a
    lower triangular root of it is given.
    """
    z = torch.randn(num_particles, *noise.shape, generator=generator, dtype=torch.float64)
    if root is not None:
        z[..., spec.predicted] = z[..., spec.predicted] @ root.mT
    for name, velocity in spec.integrated.items():
        z[..., spec.states.index(name)] = z[..., spec.states.index(velocity)]
    return noise * z


def central_interval(sample: Tensor, level: float) -> tuple[Tensor, Tensor]:
    """Ends between which a further draw lies with this probability, from ``K x ...``."""
    low, high = (_order_statistic(sample, p) for p in ((1 - level) / 2, (1 + level) / 2))
    return low, high


def check_enough(num_functions: int, level: float) -> None:
    """Raise a ValueError unless so many particles have an interval of this probability."""
    checked_whole("num_functions", num_functions, 1)
    least = math.ceil(2 / (1 - level) - 1 - _ROUNDING)  # whose outermost two are its ends
    if num_functions < least:
        raise ValueError(
            f"Expected num_functions >= {least}, without which there are no ends of an "
            f"interval of {100 * level:g} %, got {num_functions}."
        )


def _order_statistic(sample: Tensor, level: float) -> Tensor:
    """The value that a further draw is below with this probability, from ``K x ...``: ``...``.

    The i-th smallest of K draws is so with probability i / (K + 1); between them it is a line.
    """
    ordered = sample.sort(0).values
    place = level * (len(sample) + 1) - 1
    below = min(max(int(place), 0), len(sample) - 2)
    return ordered[below].lerp(ordered[below + 1], min(max(place - below, 0.0), 1.0))


def even_normal(number: int, p: int, seed: int) -> Tensor:
    """Standard normal draws ``number x p`` that fill space evenly (Sobol)."""
    engine = torch.quasirandom.SobolEngine(p, scramble=True, seed=seed)
    shares = engine.draw(number, dtype=torch.float64).clamp(1e-6, 1 - 1e-6)
    return torch.special.ndtri(shares)


def of_states(values: Tensor, name: str, shape: tuple[int, ...]) -> Tensor:
    """The user's numbers, one or more for each state, in float64; an error if they are none."""
    values = checked_tensor(name, values)
    if values.shape != shape:
        raise ValueError(
            f"Expected {name} of shape {' x '.join(map(str, shape))}, an entry for each state, got "
            f"shape {tuple(values.shape)}."
        )
    return values


def varying_parameters(
    physics: Physics,
    spec: StateSpec,
    learnt: PhysicsParameters,
    actions: Tensor,
    variation: Tensor | float,
) -> Callable[[int, int | None], Callable[[Tensor, Tensor], Tensor]]:
    """Changes of next states by parameters that differ, in each draw by numbers of its own.

    They vary by standard deviations of their coordinates about those that were learnt, by more
    beyond the actions that were learnt from, ``N x action_dim``.

    Returns:
        A function of a number ``k`` of draws and a seed to a function of states and actions, which
        returns by how much next states ``k x N x state_dim`` are others than by what was learnt,
        NaN where the physics fails.

    Raises:
        TypeError: If ``variation`` is no number or numbers.
        ValueError: If it is not one of 0 or more, or one for each parameter.
    """
    unknowns, moving, p = physics.unknowns, spec.moving, len(physics.unknowns)
    sd = checked_tensor("variation", variation)
    if sd.shape not in ((), (p,)) or not (sd.isfinite() & (sd >= 0)).all():
        raise ValueError(
            f"Expected variation as one number of 0 or more, or one for each of "
            f"{', '.join(unknowns)}, got {sd.tolist()}."
        )
    sd = sd.expand(p)
    center = unknowns.coordinates(learnt.draws).clamp(-_END, _END).mean(0)
    low, high = actions.amin(0), actions.amax(0)
    # Of an action that never varied, its own size.
    half = ((high - low) / 2).where(high > low, high.abs().where(high != 0, torch.ones_like(high)))

    def growth(actions: Tensor) -> Tensor:
        """The factor of the standard deviations under actions, ``... x 1``."""
        beyond = (low - actions).clamp_min(0) + (actions - high).clamp_min(0)
        return 1 + _BEYOND * (beyond / half).norm(dim=-1, keepdim=True)

    def changes(number: int, seed: int | None) -> Callable[[Tensor, Tensor], Tensor]:
        seed = int(torch.randint(2**31, ())) if seed is None else seed
        drawn = even_normal(number, p, seed).unsqueeze(1)  # number x 1 x p

        def change(states: Tensor, actions: Tensor) -> Tensor:
            actions = actions.expand(*states.shape[:-1], -1)
            X = spec.physics_inputs(states, actions)
            own = torch.minimum(sd * growth(actions), sd.clamp_min(_MOST))
            rows = X.flatten(0, -2).unsqueeze(1)  # each with parameters of its own
            ends = []
            for coordinates in (center + own * drawn, center.expand(*own.shape)):
                values = unknowns.at(coordinates.flatten(0, -2))
                end = states.clone()
                end[..., moving] = physics.or_nan(rows, values).view(*states.shape[:-1], -1)
                ends.append(end)
            return spec.change(ends[1], ends[0])

        return change

    return changes
