"""Free runs: where given actions lead from given states, with intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import check_finite, check_level, checked_whole
from gpadjust.dynamics.particles import (
    Move,
    about_center,
    central_interval,
    check_enough,
    measurement_noise,
    move_on,
    of_states,
    step_or_nan,
)
from gpadjust.dynamics.trajectories import check_doubles
from gpadjust.states import StateSpec
from gpadjust.validation import Scores, energy_score

_ROWS = 1024  # whose noise is asked for at once
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


def free_run(
    spec: StateSpec,
    sample_functions: Callable[[int, int], Move],
    noise_variance: Move,
    initial_states: Tensor,
    actions: Tensor,
    *,
    num_functions: int,
    level: float,
    noise: Tensor | bool,
    start_noise: Tensor | Literal["learnt"] | None,
    process_noise: Tensor | Literal["learnt"] | None,
    state_bounds: Tensor | None,
    seed: int,
) -> FreeRun:
    """Free runs of dynamics; for the arguments see :meth:`~gpadjust.dynamics.Dynamics.free_run`."""
    _check_start(spec, initial_states, actions)
    check_level(level)
    check_enough(num_functions, level)
    if state_bounds is not None:
        state_bounds = of_states(state_bounds, "state_bounds", (2, spec.state_dim))
    start_noise, process_noise = (
        _checked_noise(spec, given, name)
        for given, name in ((start_noise, "start_noise"), (process_noise, "process_noise"))
    )
    sensors = None if isinstance(noise, bool) else _checked_noise(spec, noise, "noise")
    if noise is True and isinstance(process_noise, str):
        raise ValueError(
            "The learnt noise moves particles on (process_noise='learnt'), so that it is not that "
            "of measurements as well; say the noise of these, such as noise=smoothed.noise of "
            "smooth(records, physics), or noise=False."
        )
    generator = torch.Generator().manual_seed(seed)
    # Dynamics of a user's may draw from PyTorch's generator all the same.
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        functions = sample_functions(num_functions, seed)
        particles = initial_states.expand(num_functions, -1, -1)
        if isinstance(start_noise, str):
            variance = step_or_nan(noise_variance, initial_states, actions[:, 0])
            start_noise = _with_lags(spec, (variance.nan_to_num(nan=0.0) / 2).sqrt())
        if start_noise is not None:
            error = start_noise.expand_as(initial_states)
            particles = particles + measurement_noise(spec, error, num_functions, generator)
        lost = torch.zeros(particles.shape[:2], dtype=torch.bool)
        path, lost_by_then = [], []
        for each in actions.unbind(1):
            before, added = particles, None
            if not isinstance(process_noise, str):
                added = process_noise
            else:
                middle = about_center(spec, particles)[0]
                added = step_or_nan(noise_variance, middle, each).nan_to_num(nan=0.0).sqrt()
            particles, lost = move_on(functions, particles, lost, each, state_bounds)
            if added is not None:
                error = torch.zeros_like(initial_states)
                error[:, spec.moving] = added.expand_as(initial_states)[:, spec.moving]
                moved = measurement_noise(spec, error, num_functions, generator)
                particles = particles + moved.masked_fill(lost.unsqueeze(-1), 0.0)
                if state_bounds is not None:
                    low, high = state_bounds
                    lost = lost | ((particles < low) | (particles > high)).any(-1)
                    particles = torch.where(lost.unsqueeze(-1), before, particles)
            path.append(particles)
            lost_by_then.append(lost.double().mean(0))
        center, cloud = about_center(spec, torch.stack(path, dim=2))
        center = _without_jumps(spec, initial_states, center)
        mean = center + cloud.mean(0)
        if isinstance(sensors, Tensor):
            error = sensors.expand_as(center)
            cloud = cloud + measurement_noise(spec, error, num_functions, generator)
        elif noise:
            before = torch.cat([initial_states.unsqueeze(1), mean[:, :-1]], dim=1)
            rows = before.flatten(0, 1).split(_ROWS), actions.flatten(0, 1).split(_ROWS)
            variances = [step_or_nan(noise_variance, *part) for part in zip(*rows, strict=True)]
            scatter = _with_lags(spec, torch.cat(variances).sqrt().view_as(center))
            cloud = cloud + measurement_noise(spec, scatter, num_functions, generator)
    low, high = central_interval(cloud, level)
    return FreeRun(
        mean=mean,
        lower=center + low,
        upper=center + high,
        particles=center + cloud,
        lost=torch.stack(lost_by_then, 1),
        spec=spec,
        level=level,
        initial_states=initial_states,
    )


def _checked_noise(
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


def _with_lags(spec: StateSpec, noise: Tensor) -> Tensor:
    """Noise ``... x state_dim`` of measured states, whose lags were measured alike."""
    noise = noise.clone()
    for name in spec.previous:
        held = name
        while held in spec.previous:
            held = spec.previous[held]
        if held in spec.states:
            noise[..., spec.states.index(name)] = noise[..., spec.states.index(held)]
    return noise


def _without_jumps(spec: StateSpec, initial_states: Tensor, path: Tensor) -> Tensor:
    """A path ``w x T x state_dim`` whose angles go on from those of the initial states."""
    path, angles = path.clone(), spec.angle_columns
    before = torch.cat([initial_states.unsqueeze(1), path[:, :-1]], dim=1)
    change = spec.change(before, path)[..., angles]
    path[..., angles] = before[:, :1, angles] + change.cumsum(1)
    return path


def _check_start(spec: StateSpec, initial_states: Tensor, actions: Tensor) -> None:
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
