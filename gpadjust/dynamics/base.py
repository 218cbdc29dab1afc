"""Dynamics: distributions of the next state, and free runs of particles through them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from gpadjust.checks import (
    check_columns,
    check_finite,
    check_kind,
    check_level,
    checked_tensor,
    checked_whole,
    seeded,
)
from gpadjust.core import Prediction
from gpadjust.dynamics.state import fingerprint
from gpadjust.dynamics.trajectories import Trajectories, check_doubles
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec
from gpadjust.validation import Scores
from gpadjust.validation.scores import energy_score

TransitionFunctions = Callable[[Tensor, Tensor], Tensor]
"""Functions from states and actions, ``k x N x ...``, to next states: a sample of the dynamics."""

Sampler = Callable[[int, int | None], TransitionFunctions]  # of a number of functions, and a seed

_ROWS = 1024  # per call of noise_variance
_AT_ONCE = 8  # windows whose particles move together: more leave the cache, at half the speed
_CERTAIN = 1e-9  # of the range of the means: a spread of rounding errors


class Dynamics(ABC):
    """A distribution of the next state, given a state and an action.

    All tensors are float64 and in the user's units: states ``N x state_dim``, actions
    ``N x action_dim``, see :class:`StateSpec`. Angles need not be wrapped.
    """

    def __init__(self, spec: StateSpec) -> None:
        expected = "a StateSpec, such as StateSpec(['x', 'v'], ['force'])"
        check_kind("spec", spec, StateSpec, expected)
        self.spec = spec

    @property
    @abstractmethod
    def is_fitted(self) -> bool:
        """True if it can predict."""

    @property
    def has_learnt(self) -> bool:
        """True after an update by transitions, or if there is nothing to update."""
        return self.is_fitted

    @abstractmethod
    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Update the dynamics by further transitions, ``N`` rows each."""

    @abstractmethod
    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """Return mean and variance of each entry of the next states, ``N x state_dim`` each."""

    @abstractmethod
    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Draw ``k`` transition *functions*, so that particles stay consistent along a trajectory.

        They are one deterministic function of states ``k x N x state_dim`` and actions
        ``k x N x action_dim`` to next states, a draw for each block, which later updates do not
        change. Without a seed they are of PyTorch's generator.
        """

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """Draw next states, ``N x state_dim``, by default each entry from its own Gaussian."""
        mean, variance = self.predict(states, actions)
        return mean + variance.sqrt() * torch.randn_like(mean)

    def mean_function(self) -> TransitionFunctions:
        """Return the mean of predictions as a function of any ``k`` blocks."""
        return lambda states, actions: self.predict(states, actions).mean

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the variance of measured next states about a sampled function, by default 0."""
        return torch.zeros_like(states)

    def noise_root(self) -> Tensor | None:
        """Return a lower triangular root of the noise correlation of predicted states, or None."""
        return None

    def before_data(self) -> Dynamics | None:
        """Return dynamics to use before there are transitions, or None."""
        return self if self.is_fitted else self.physics_alone()

    def physics_alone(self) -> Dynamics | None:
        """Return the physics without corrections; None by default, and if there are several."""
        return None

    def try_physics(self, states: Tensor, actions: Tensor) -> None:
        """Evaluate the physics before there are transitions, to raise its errors early."""
        dynamics = self.before_data()
        if dynamics is not None:
            dynamics.predict(states, actions)

    def score(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Scores:
        r"""Compare predictions with transitions that no update had.

        The outputs are the states that move, in the spec's order. The variance of an integrated
        state is :math:`(h / 2)^2` times the variance of its velocity, without the error of the
        trapezoid rule. A state with zero variance has only ``rmse`` and ``median``.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
            next_states: ``N x state_dim``; NaN where an entry was not measured.
        """
        data = Trajectories.checked(self.spec, states, actions, next_states)
        moving = self.spec.moving
        mean, variance = self.predict(data.states, data.actions)
        measured = mean + self.spec.change(mean, data.next_states)  # angles the shortest way round
        mean, variance, measured = (part[:, moving] for part in (mean, variance, measured))
        # A variance of zero has no density: NaN leaves such states out of nlpd and coverage.
        variance = variance.masked_fill((variance <= 0).any(0), torch.nan)
        names = [self.spec.states[i] for i in moving]
        return Scores.compute(mean, variance, measured, output_names=names)

    def free_run(
        self,
        initial_states: Tensor,
        actions: Tensor,
        *,
        num_functions: int = 39,
        level: float = 0.95,
        noise: Tensor | bool = True,
        start_noise: Tensor | Literal["learnt"] | None = None,
        process_noise: Tensor | Literal["learnt"] | None = None,
        variation: Tensor | float | None = None,
        state_bounds: Tensor | None = None,
        seed: int = 0,
    ) -> FreeRun:
        """Simulate sequences of actions from initial states, without measurements on the way.

        Functions drawn from the dynamics follow the actions; see :class:`FreeRun`.
        :meth:`Trajectories.windows` returns initial states, actions, and measured states for
        :meth:`FreeRun.score`. All noises are standard deviations, ``state_dim``.

        Args:
            initial_states: ``w x state_dim``.
            actions: ``w x T x action_dim``.
            num_functions: Number of functions, one for each particle: at least 39 for intervals of
                95 %.
            level: The probability of the intervals.
            noise: Errors of measured states, included in intervals and particles. True: the noise
                estimated by the dynamics (joint, for clearly correlated entries). False: none.
            start_noise: Errors of the initial states. ``"learnt"``: half of the variance of the
                estimated noise, right if it comes from measuring both ends of a transition.
            process_noise: Disturbances of the state itself in each step. ``"learnt"``: the
                estimated noise, right for updates by states without noise, such as draws of
                :func:`smooth`.
            variation: Deviations of the physics' unknown parameters between runs, one for each or
                one for all, in standard deviations of their priors: ``smoothed.variation`` of
                :func:`smooth`; more for another machine. Each particle has its own parameters.
                Beyond the actions of the updates the deviations grow, threefold at half of their
                range, but to at most half of the prior's.
            state_bounds: Lower and upper bounds, ``2 x state_dim``, as of a task: a particle that
                would leave them stops.
            seed: Seed of functions and noise; PyTorch's generator is not changed.

        Raises:
            RuntimeError: Before the first update.
            TypeError, ValueError: If shapes disagree, values are not finite float64 tensors, or an
                option is out of range.
            PhysicsError: If the physics fails, and its error does not have the rows.
        """
        spec = self.spec
        _check_start(spec, initial_states, actions)
        _check_enough(num_functions, level)
        start = _checked_noise(spec, "start_noise", start_noise)
        process = _checked_noise(spec, "process_noise", process_noise)
        sensors = _checked_noise(spec, "noise", noise)
        if isinstance(sensors, str) and isinstance(process, str):
            raise ValueError(
                "process_noise='learnt' needs another noise of measurements, as the learnt noise "
                "already moves the particles; give noise=smoothed.noise of smooth(records, "
                "physics), or noise=False."
            )
        low, high = -math.inf, math.inf
        if state_bounds is not None:
            low, high = of_states(state_bounds, "state_bounds", (2, spec.state_dim))
        sample = self.sample_functions if variation is None else self._varied(variation)
        generator = torch.Generator().manual_seed(seed)

        def scatter(noise: Tensor | str, states: Tensor, actions: Tensor) -> Tensor:
            """Draw noise of the user or the model at states ``... x state_dim`` per particle."""
            if isinstance(noise, Tensor):
                return _drawn(spec, noise.expand_as(states), num_functions, generator, None)
            rows = (part.flatten(0, -2).split(_ROWS) for part in (states, actions))
            parts = zip(*rows, strict=True)
            variance = torch.cat([step_or_nan(self.noise_variance, *part) for part in parts])
            sd = _with_lags(spec, variance.sqrt().view_as(states))
            return _drawn(spec, sd, num_functions, generator, self.noise_root())

        def is_outside(states: Tensor) -> Tensor:
            return ~(states.isfinite() & (states >= low) & (states <= high)).all(-1)

        # Dynamics of a user may draw from PyTorch's generator, in spite of their seed.
        with torch.no_grad(), seeded(seed):
            functions = sample(num_functions, seed)
            particles = initial_states.expand(num_functions, -1, -1)
            if start is not None:
                # The noise of a transition has two ends: one of them has half of the variance.
                share = 1.0 if isinstance(start, Tensor) else 0.5
                disturbance = scatter(start, initial_states, actions[:, 0]).nan_to_num()
                particles = particles + share**0.5 * disturbance
            is_lost = torch.zeros(particles.shape[:2], dtype=torch.bool)
            path: list[Tensor] = []
            lost: list[Tensor] = []
            for action in actions.unbind(1):
                # s' = f_k(s, a) + process noise, unless the particle is lost
                following = _moved(functions, particles, action)
                is_lost = is_lost | is_outside(following)
                if process is not None:
                    disturbance = scatter(process, _center(spec, particles), action).nan_to_num()
                    following[..., spec.moving] += disturbance[..., spec.moving]
                    is_lost = is_lost | is_outside(following)
                particles = torch.where(is_lost.unsqueeze(-1), particles, following)
                path.append(particles)
                lost.append(is_lost.double().mean(0))
            particles = torch.stack(path, dim=2)
            # Moments and quantiles of angles need a center: distances from it are within a turn.
            center = _center(spec, particles)
            cloud = spec.change(center.expand_as(particles), particles)
            center = without_jumps(spec, initial_states, center)
            mean = center + cloud.mean(0)
            if sensors is not None:
                before = torch.cat([initial_states.unsqueeze(1), mean[:, :-1]], dim=1)
                cloud = cloud + scatter(sensors, before, actions)
        lower, upper = (center + end for end in central_interval(cloud, level))
        shares = torch.stack(lost, 1)
        return FreeRun(mean, lower, upper, center + cloud, shares, spec, level, initial_states)

    def _varied(self, variation: Tensor | float) -> Sampler:
        """Return `sample_functions` with varying parameters of the physics."""
        raise ValueError(
            f"variation={variation!r} needs LearnedDynamics with one physics and unknown "
            f"parameters; found {type(self).__name__}, several physics or no unknown parameters."
        )

    def describe(self) -> dict[str, str]:
        """Return each setting of these dynamics as a text; by default, class and spec."""
        return fingerprint(type(self), self.spec)

    def state_dict(self) -> dict[str, Any]:
        """Return the results of all updates in tensors and plain values, without physics and spec.

        A class of your own without this method raises a NotImplementedError.
        """
        raise NotImplementedError(
            f"{type(self).__name__} cannot be saved or loaded. Give it state_dict() and "
            "load_state_dict(state), or use no checkpoints and no sensors."
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a result of :meth:`state_dict`; predictions and later fits are then the same."""
        Dynamics.state_dict(self)  # raises the error of dynamics that cannot be saved

    def _checked(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Trajectories:
        """Return transitions that agree with the spec."""
        data = Trajectories.checked(self.spec, states, actions, next_states)
        self.spec.check_transitions(*data)
        return data

    def _check_blocks(self, states: Tensor, actions: Tensor, number: int | None = None) -> None:
        """Raise an error unless states have actions, and a block for each function."""
        check_doubles("states", states, self.spec.state_dim)
        check_columns("actions", actions, self.spec.action_dim)
        sizes = zip(reversed(actions.shape[:-1]), reversed(states.shape[:-1]), strict=False)
        if actions.dim() > states.dim() or any(size not in (1, other) for size, other in sizes):
            raise ValueError(
                "Expected an action for each state, or one for all, got states of shape "
                f"{tuple(states.shape)} and actions of shape {tuple(actions.shape)}."
            )
        if number is not None and (states.dim() != 3 or len(states) != number):
            raise ValueError(
                f"Expected states of shape {number} x N x {self.spec.state_dim}, a block for each "
                f"function, got {tuple(states.shape)}."
            )


class FreeRun(NamedTuple):
    r"""Predicted states along ``w`` sequences of ``T`` actions, with an initial state each.

    Step t is the state after t + 1 actions. Each of the ``K`` particles follows one function drawn
    from the dynamics. Measurement noise is added to the reported states alone; process noise moves
    the particles themselves. A particle that would leave the bounds or the finite numbers, or where
    the physics fails, is lost: it stops.

    The mean of an angle is the mean on the circle. It continues from the initial state without
    jumps of :math:`2 \pi`, and interval and particles of each step are around it: compare with
    measurements by ``spec.change(run.mean, measured)``.

    Args:
        mean: ``w x T x state_dim``.
        lower: Quantile of the states at ``(1 - level) / 2``, ``w x T x state_dim``: an order
            statistic of the particles, valid for any distribution. NaN where the noise is not
            known, as the physics fails at the mean before.
        upper: Quantile at ``(1 + level) / 2``.
        particles: ``K x w x T x state_dim``; without noise, an angle is within half a turn of the
            mean.
        lost: Share of lost particles up to each step, ``w x T``.
        spec: Names and kinds of the entries of states.
        level: The probability of the intervals.
        initial_states: ``w x state_dim``.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> dynamics = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + X[:, 1:])
        >>> x, v = torch.zeros(2, 1).double(), torch.ones(2, 3, 1).double()
        >>> measured = torch.tensor([[1.0, 2, 4], [1, 3, 2]]).double().unsqueeze(-1)
        >>> dynamics.free_run(x, v).score(measured).rmse.flatten()
        tensor([0.0000, 0.7071, 1.0000], dtype=torch.float64)
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
        """Compare the runs with measured states that no update had.

        Scores are over all windows, ``T x state_dim``; ``scores[t]`` is after t + 1 steps. Angles
        are compared the shortest way round. The predicted distribution is the Gaussian with the
        particles' mean and variance (with 39 particles its ``nlpd`` is some 0.03 nats too high),
        and coverage is that of the interval. States without a spread of the particles in a window
        have only ``rmse`` and ``median``. In an unstable system a few runs to the wrong side
        dominate a mean square: use the median. ``energy`` is joint over all states that move.

        Args:
            measured: ``w x T x state_dim``, as ``measured`` of :meth:`Trajectories.windows`; NaN
                where an entry was not measured.
            horizons: Numbers of steps to score, such as ``(1, 5, 15)``. Default: all, 1 to ``T``.
            units: Units of the states in the energy score, ``state_dim``. Default: the root mean
                square of their changes in a step, in these windows.

        Raises:
            TypeError, ValueError: If ``measured`` is not a float64 tensor of the runs' shape, an
                entry is infinite, a unit is not positive, or a horizon is not a step of the runs.
        """
        spec = self.spec
        length = self.mean.shape[1]
        check_doubles("measured", measured, spec.state_dim)
        if measured.shape != self.mean.shape or measured.isinf().any():
            raise ValueError(
                f"Expected measured of shape w x T x state_dim {tuple(self.mean.shape)}, as the "
                "runs' means, finite or NaN where it was not measured, got shape "
                f"{tuple(measured.shape)}; take `windows.measured` of the windows that the runs "
                "start from."
            )
        steps = checked_horizons(range(1, length + 1) if horizons is None else horizons)
        if steps[-1] > length:
            raise ValueError(
                f"Expected horizons of at most the {length} steps of the runs, got {steps[-1]}; "
                "take longer windows."
            )
        if units is None:
            before = torch.cat([self.initial_states.unsqueeze(1), measured[:, :-1]], dim=1)
            units = typical_change(spec, before, measured)
        units = of_states(units, "units", (spec.state_dim,))
        if not (units.isfinite() & (units > 0)).all():
            raise ValueError(f"Expected units that are finite and positive, got {units.tolist()}.")
        # Zero variance has no density: NaN leaves such states out of nlpd and coverage.
        variance = self.particles.var(0)
        range_of_means = self.mean.amax((0, 1)) - self.mean.amin((0, 1))
        is_certain = (variance.sqrt() <= _CERTAIN * range_of_means).any(0)
        variance = variance.masked_fill(is_certain, torch.nan)
        measured = self.mean + spec.change(self.mean, measured)
        parts = self.mean, variance, measured, self.lower, self.upper, self.particles
        rows = torch.tensor(steps) - 1  # step by step: ... x H x w x state_dim
        mean, variance, measured, *ends, draws = (
            part[..., rows, :].transpose(-3, -2) for part in parts
        )
        draws, y = ((part / units)[..., spec.moving] for part in (draws, measured))
        y = y.masked_fill(draws.isnan().any(0), torch.nan)  # where the physics fails
        return Scores.compute(
            mean,
            variance,
            measured,
            level=self.level,
            interval=(ends[0], ends[1]),
            energy=energy_score(draws, y),
            output_names=spec.states,
        )


def step_or_nan(
    move: Callable[[Tensor, Tensor], Tensor],
    states: Tensor,
    actions: Tensor,
    *,
    some_must_succeed: bool = False,
) -> Tensor:
    """Return the next states ``N x state_dim``; NaN where the physics fails.

    A PhysicsError without rows is raised, and one of all rows if ``some_must_succeed``.
    """
    states, actions = states.clone(), actions.clone()
    failed = torch.zeros(len(states), dtype=torch.bool)
    while True:
        try:
            following = move(states, actions)
        except PhysicsError as error:
            failed_before = failed.clone()
            failed[list(error.rows)] = True
            if (failed == failed_before).all() or (failed.all() and some_must_succeed):
                raise  # it does not have the rows, or rows that have been replaced
            if failed.all():
                return torch.full_like(states, torch.nan)
            # Evaluate again, with failed rows replaced by one where the physics may not fail.
            working = int((~failed).nonzero()[0])
            states[failed] = states[working].clone()
            actions[failed] = actions[working].clone()
        else:
            return following.masked_fill(failed[:, None], torch.nan) if failed.any() else following


def _moved(functions: TransitionFunctions, particles: Tensor, actions: Tensor) -> Tensor:
    """Return particles ``K x w x state_dim`` after actions ``w x action_dim``."""
    number = len(particles)

    def move(*rows: Tensor) -> Tensor:
        blocks = (part.unflatten(0, (number, -1)).split(_AT_ONCE, dim=1) for part in rows)
        return torch.cat([functions(*part) for part in zip(*blocks, strict=True)], 1).flatten(0, 1)

    actions = actions.expand(number, -1, -1).flatten(0, 1)
    return step_or_nan(move, particles.flatten(0, 1), actions).view_as(particles)


def _center(spec: StateSpec, particles: Tensor) -> Tensor:
    """Return the mean of particles ``K x ... x state_dim``, of angles on the circle."""
    center = particles.mean(0)
    for i in spec.angle_columns:
        angle = particles[..., i]
        # the direction of the mean of the unit vectors
        center[..., i] = torch.atan2(angle.sin().mean(0), angle.cos().mean(0))
    return center


def without_jumps(spec: StateSpec, initial_states: Tensor, path: Tensor) -> Tensor:
    """Return a path ``w x T x state_dim`` with angles that continue from the initial states."""
    path = path.clone()
    angles = spec.angle_columns
    before = torch.cat([initial_states.unsqueeze(1), path[:, :-1]], dim=1)
    change = spec.change(before, path)[..., angles]
    path[..., angles] = before[:, :1, angles] + change.cumsum(1)
    return path


def _with_lags(spec: StateSpec, noise: Tensor) -> Tensor:
    """Return noise ``... x state_dim`` with that of each lag taken from its measured state."""
    noise = noise.clone()
    for name, origin in spec.previous.items():
        while origin in spec.previous:
            origin = spec.previous[origin]
        if origin in spec.states:
            noise[..., spec.states.index(name)] = noise[..., spec.states.index(origin)]
    return noise


def _drawn(
    spec: StateSpec, sd: Tensor, number: int, generator: torch.Generator, root: Tensor | None
) -> Tensor:
    """Draw noise ``number x ... x state_dim``; an integrated state shares that of its velocity."""
    z = torch.randn(number, *sd.shape, generator=generator, dtype=torch.float64)
    if root is not None:  # correlation R = root root^T
        z[..., spec.predicted] = z[..., spec.predicted] @ root.mT
    for name, velocity in spec.integrated.items():
        z[..., spec.states.index(name)] = z[..., spec.states.index(velocity)]
    return sd * z


def central_interval(sample: Tensor, level: float) -> tuple[Tensor, Tensor]:
    """Return the ends between which a further draw lies with this probability, of ``K x ...``.

    It is below the i-th smallest of K with probability i / (K + 1), interpolated linearly.
    """
    ordered = sample.sort(0).values
    ends = []
    for probability in ((1 - level) / 2, (1 + level) / 2):
        # i = probability (K + 1), counted from 1
        place = probability * (len(sample) + 1) - 1
        below = min(max(int(place), 0), len(sample) - 2)
        share = min(max(place - below, 0.0), 1.0)
        ends.append(ordered[below].lerp(ordered[below + 1], share))
    return ends[0], ends[1]


def typical_change(spec: StateSpec, states: Tensor, next_states: Tensor) -> Tensor:
    """Return the root mean square change of each state in a step; 1 if it never changed."""
    size = spec.change(states, next_states).flatten(0, -2).square().nanmean(0).sqrt()
    return size.where(size > 0, torch.ones_like(size))


def _check_start(spec: StateSpec, initial_states: Tensor, actions: Tensor) -> None:
    """Raise an error unless each state has a sequence of actions, and all are finite."""
    check_doubles("initial_states", initial_states, spec.state_dim)
    check_doubles("actions", actions, spec.action_dim)
    fits = initial_states.dim() == 2 and actions.dim() == 3 and len(initial_states) == len(actions)
    if not fits or not actions.numel():
        raise ValueError(
            f"Expected initial_states of shape w x {spec.state_dim} and actions of shape w x T x "
            f"{spec.action_dim}, one sequence of one or more actions for each state, got "
            f"{tuple(initial_states.shape)} and {tuple(actions.shape)}; for a single run, use "
            "`initial_state.unsqueeze(0)` and `actions.unsqueeze(0)`."
        )
    check_finite("initial_states", initial_states)
    check_finite("actions", actions)


def _check_enough(num_functions: int, level: float) -> None:
    """Raise an error if there are too few particles for an interval of this probability."""
    check_level(level)
    # The outermost particles are the ends: 1 / (K + 1) <= (1 - level) / 2
    least = math.ceil(round(2 / (1 - level), 9)) - 1
    if checked_whole("num_functions", num_functions, 1) < least:
        raise ValueError(
            f"Expected num_functions >= {least}, for an interval of {100 * level:g} %, got "
            f"{num_functions}."
        )


def _checked_noise(spec: StateSpec, name: str, noise: Any) -> Tensor | Literal["learnt"] | None:
    """Return standard deviations ``state_dim``, "learnt" or None."""
    off: Any = None
    learnt: Any = "learnt"
    words = "'learnt'"
    if name == "noise":  # a switch; the other options are None or "learnt"
        off, learnt, words = False, True, "True or False"
    if noise is off:
        return None
    if isinstance(noise, str | bool):
        if noise == learnt:
            return "learnt"
        raise ValueError(f"Expected {name} as {words} or a tensor, got {noise!r}.")
    sd = of_states(noise, name, (spec.state_dim,))
    if not (sd.isfinite() & (sd >= 0)).all():
        raise ValueError(
            f"Expected {name} of 0 or more, got {sd.tolist()}; for states that are never measured "
            "`.nan_to_num()` makes it 0."
        )
    return sd


def checked_horizons(horizons: Sequence[int]) -> tuple[int, ...]:
    """Return numbers of steps in order; raise an error unless they differ, and are at least 1."""
    is_list = isinstance(horizons, Sequence) and len(horizons) > 0
    if not is_list or len({*horizons}) < len(horizons):
        raise ValueError(
            "Expected horizons as different numbers of steps, such as (1, 5, 15), got "
            f"{horizons!r}."
        )
    return tuple(sorted(checked_whole("each horizon", horizon, 1) for horizon in horizons))


def of_states(values: Any, name: str, shape: tuple[int, ...]) -> Tensor:
    """Return the user's numbers, one or more for each state, in float64."""
    values = checked_tensor(name, values)
    if values.shape != shape:
        expected = " x ".join(map(str, shape))
        raise ValueError(
            f"Expected {name} of shape {expected}, an entry for each state, got shape "
            f"{tuple(values.shape)}."
        )
    return values
