"""Free runs: where given actions lead from given states, with intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import check_finite, checked_tensor, checked_whole
from gpadjust.dynamics.trajectories import check_doubles
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec
from gpadjust.validation import Scores
from gpadjust.validation.scores import energy_score

_AT_ONCE = 8  # windows whose particles move together: more leave the cache, at half the speed
_ROUNDING = 1e-9  # of a number of particles
_CERTAIN = 1e-9  # of how far the means range: a spread that is one of rounding errors


class FreeRun(NamedTuple):
    r"""Predicted states along ``w`` sequences of ``T`` actions, each from its own state.

    Step t is the state after t + 1 actions. Each of the ``K`` particles follows one function drawn
    from the dynamics, and nothing that was measured on the way. Noise is added to what is reported
    of each step, as to a measurement of it, and moves nothing on: as noise of the process it would
    do more after T steps than is assumed here. Process noise moves the particles themselves. A
    particle that is lost, because it would leave the bounds or the finite numbers or meet a failure
    of the physics, stays where it was before.

    The mean of an angle is that on the circle. It goes on from the initial state without jumps of
    :math:`2 \pi`, and interval and particles of each step are about it: compare with what was
    measured by ``spec.change(run.mean, measured)``.

    Args:
        mean: ``w x T x state_dim``.
        lower: What a state, measured if the noise was asked for, is above with probability
            ``(1 + level) / 2``, ``w x T x state_dim``: an order statistic of the particles, which
            holds for any distribution. NaN where the physics fails at the mean before, for the
            noise's sake.
        upper: What it is below with that probability.
        particles: ``K x w x T x state_dim``, with the noise if that was asked for. An angle is
            within half a turn of the mean, but for the noise.
        lost: Share of the particles that are lost by then, ``w x T``.
        spec: What the entries of states are.
        level: The probability of the intervals.
        initial_states: Where the runs start, ``w x state_dim``.
    """

    mean: Tensor
    lower: Tensor
    upper: Tensor
    particles: Tensor
    lost: Tensor
    spec: StateSpec
    level: float
    initial_states: Tensor

    def score(
        self,
        measured: Tensor,
        *,
        horizons: Sequence[int] | None = None,
        units: Tensor | None = None,
    ) -> Scores:
        """Judge the runs by what was measured of states that were not learnt from.

        Scores are over all windows, ``T x state_dim``; ``scores[t]`` are those after t + 1 steps.
        Angles are compared the shortest way round. What was measured has noise: so should the
        runs, as they do by default. The predicted distribution is the Gaussian with the particles'
        mean and variance (with 39 particles its ``nlpd`` is some 0.03 nats more than their number
        itself deserves), coverage that of the interval between ``lower`` and ``upper``. States in
        which the particles of a window have no spread, which says nothing of errors, have ``rmse``
        and ``median`` only. Of an unstable system a few runs that fall to the other side make up
        most of a mean square: look at the median. ``energy`` is of all states that move together.

        Args:
            measured: ``w x T x state_dim``, as ``measured`` of :meth:`Trajectories.windows`; NaN
                where an entry was not measured.
            horizons: After which numbers of steps, such as ``(1, 5, 15)``, from the least to the
                greatest. Default: all, 1 to ``T``.
            units: What states are measured in for the energy score, ``state_dim``. Default: the
                root mean square of their changes in a step, in these windows.

        Raises:
            TypeError: If it is no float64 tensor.
            ValueError: If its shape is not that of the means, an entry is infinite, a unit is not
                positive, or a horizon is none of the runs' steps.

        Example:
            >>> import torch
            >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
            >>> dynamics = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + X[:, 1:])
            >>> x, v = torch.zeros(2, 1).double(), torch.ones(2, 3, 1).double()
            >>> measured = torch.tensor([[1.0, 2, 4], [1, 3, 2]]).double().unsqueeze(-1)
            >>> dynamics.free_run(x, v).score(measured).rmse.flatten()
            tensor([0.0000, 0.7071, 1.0000], dtype=torch.float64)
        """
        check_doubles("measured", measured, self.spec.state_dim)
        if measured.shape != self.mean.shape:
            raise ValueError(
                f"Expected measured of shape w x T x state_dim {tuple(self.mean.shape)}, that of "
                f"the runs' means, got {tuple(measured.shape)}; of `windows` that the runs start "
                "from it is `windows.measured`."
            )
        if measured.isinf().any():
            raise ValueError(
                "Expected measured to be finite, found infinity; put NaN where an entry was not "
                "measured."
            )
        steps = torch.arange(self.mean.shape[1])
        if horizons is not None:
            steps = torch.tensor(checked_horizons(horizons)) - 1
            if (length := self.mean.shape[1]) <= steps[-1]:
                raise ValueError(
                    f"Expected horizons of at most the {length} steps of the runs, got "
                    f"{int(steps[-1]) + 1}; take longer windows."
                )
        if units is None:
            before = torch.cat([self.initial_states.unsqueeze(1), measured[:, :-1]], dim=1)
            units = typical_change(self.spec, before, measured)
        units = of_states(units, "units", (self.spec.state_dim,))
        if not (units.isfinite() & (units > 0)).all():
            raise ValueError(f"Expected units that are finite and positive, got {units.tolist()}.")
        found, variance = self.mean + self.spec.change(self.mean, measured), self.particles.var(0)
        range_of_means = self.mean.amax((0, 1)) - self.mean.amin((0, 1))
        silent = (variance.sqrt() <= _CERTAIN * range_of_means).any(0)
        variance = variance.masked_fill(silent, torch.nan)
        parts = self.mean, variance, found, self.lower, self.upper, self.particles
        # Step by step: ... x H x w x state_dim.
        mean, variance, found, *ends, draws = (x[..., steps, :].transpose(-3, -2) for x in parts)
        draws, y = ((x / units)[..., self.spec.moving] for x in (draws, found))
        y = y.masked_fill(draws.isnan().any(0), torch.nan)  # where the physics fails
        return Scores.of(
            mean,
            variance,
            found,
            level=self.level,
            interval=(ends[0], ends[1]),
            energy=energy_score(draws, y),
            output_names=self.spec.states,
        )


def checked_horizons(horizons: Sequence[int]) -> tuple[int, ...]:
    """The numbers of steps, in order; an error unless they are different, and at least 1."""
    try:
        given = tuple(horizons)
    except TypeError:
        given = ()
    if not given or len({*given}) < len(given):
        raise ValueError(
            f"Expected horizons as different numbers of steps, such as (1, 5, 15), got "
            f"{horizons!r}."
        )
    for each in given:
        checked_whole("each horizon", each, 1)
    return tuple(sorted(given))


def checked_noise(
    spec: StateSpec, given: Tensor | str | None, name: str
) -> Tensor | Literal["learnt"] | None:
    """Standard deviations ``state_dim`` as the user said them, or what else was said."""
    if given is None:
        return None
    if isinstance(given, str):
        if given != "learnt" or name == "noise":
            learnt = "True or False" if name == "noise" else "'learnt'"
            raise ValueError(f"Expected {name} as {learnt} or a tensor, got {given!r}.")
        return "learnt"
    sd = of_states(given, name, (spec.state_dim,))
    if not (sd.isfinite() & (sd >= 0)).all():
        raise ValueError(
            f"Expected {name} of 0 or more, got {sd.tolist()}; of states that are never measured "
            "`.nan_to_num()` makes it 0."
        )
    return sd


def with_lags(spec: StateSpec, noise: Tensor) -> Tensor:
    """Noise ``... x state_dim`` of measured states, whose lags were measured alike."""
    noise = noise.clone()
    for name in spec.previous:
        held = name
        while held in spec.previous:
            held = spec.previous[held]
        if held in spec.states:
            noise[..., spec.states.index(name)] = noise[..., spec.states.index(held)]
    return noise


def without_jumps(spec: StateSpec, initial_states: Tensor, path: Tensor) -> Tensor:
    """A path ``w x T x state_dim`` whose angles go on from those of the initial states."""
    path, angles = path.clone(), spec.angle_columns
    before = torch.cat([initial_states.unsqueeze(1), path[:, :-1]], dim=1)
    change = spec.change(before, path)[..., angles]
    path[..., angles] = before[:, :1, angles] + change.cumsum(1)
    return path


def check_start(spec: StateSpec, initial_states: Tensor, actions: Tensor) -> None:
    """Raise an error unless each state has a sequence of actions, all of them finite."""
    check_doubles("initial_states", initial_states, spec.state_dim)
    check_doubles("actions", actions, spec.action_dim)
    shapes = tuple(initial_states.shape), tuple(actions.shape)
    fits = initial_states.dim() == 2 and actions.dim() == 3 and len(initial_states) == len(actions)
    if not fits or not actions.numel():
        raise ValueError(
            f"Expected initial_states of shape w x {spec.state_dim} and actions of shape w x T x "
            f"{spec.action_dim}, one sequence of one or more actions for each state, got "
            f"{shapes[0]} and {shapes[1]}; of a single run, use `initial_state.unsqueeze(0)` and "
            "`actions.unsqueeze(0)`."
        )
    check_finite("initial_states", initial_states)
    check_finite("actions", actions)


def typical_change(spec: StateSpec, states: Tensor, next_states: Tensor) -> Tensor:
    """Root mean square change of each state in a step, ``state_dim``; 1 if it never changed."""
    change = spec.change(states, next_states).flatten(0, -2)
    size = change.square().nanmean(0).sqrt()
    return size.where(size > 0, torch.ones_like(size))


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
    functions: Callable[[Tensor, Tensor], Tensor],
    particles: Tensor,
    lost: Tensor,
    actions: Tensor,
    bounds: Tensor | None,
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


def of_states(values: Tensor, name: str, shape: tuple[int, ...]) -> Tensor:
    """The user's numbers, one or more for each state, in float64; an error if they are none."""
    values = checked_tensor(name, values)
    if values.shape != shape:
        raise ValueError(
            f"Expected {name} of shape {' x '.join(map(str, shape))}, an entry for each state, got "
            f"shape {tuple(values.shape)}."
        )
    return values
