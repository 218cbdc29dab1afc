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
    check_level,
    checked_tensor,
    checked_whole,
    seeded,
)
from gpadjust.core import Prediction
from gpadjust.dynamics.state import fingerprint
from gpadjust.dynamics.targets import check_spec
from gpadjust.dynamics.trajectories import Trajectories, check_doubles
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec
from gpadjust.validation import Scores
from gpadjust.validation.scores import energy_score

TransitionFunctions = Callable[[Tensor, Tensor], Tensor]
"""Functions from states and actions, ``k x N x ...``, to next states: a sample of the dynamics."""

_ROWS = 1024  # whose noise is asked for at once
_AT_ONCE = 8  # windows whose particles move together: more leave the cache, at half the speed
_NOT_SAVED = (
    "{} cannot be saved or loaded. Give it state_dict() and load_state_dict(state), or do without "
    "checkpoints and sensors."
)
_CERTAIN = 1e-9  # of how far the means range: a spread that is one of rounding errors


class Dynamics(ABC):
    """A distribution of the next state, given a state and an action.

    All tensors are float64 and in the user's units: states ``N x state_dim``, actions
    ``N x action_dim``, see :class:`StateSpec`. Angles need not be wrapped.
    """

    def __init__(self, spec: StateSpec) -> None:
        check_spec(spec)
        self.spec = spec

    @property
    @abstractmethod
    def is_fitted(self) -> bool:
        """True once it can predict."""

    @property
    def has_learnt(self) -> bool:
        """True once it has learnt from transitions, or if it has nothing to learn."""
        return self.is_fitted

    @abstractmethod
    def update(self, states: Tensor, actions: Tensor, next_states: Tensor) -> None:
        """Learn from further transitions, ``N`` rows each."""

    @abstractmethod
    def predict(self, states: Tensor, actions: Tensor) -> Prediction:
        """Return mean and variance of the next states, ``N x state_dim`` each, entry by entry."""

    @abstractmethod
    def sample_functions(self, num_functions: int, seed: int | None = None) -> TransitionFunctions:
        """Draw transition *functions*, so that particles stay consistent along a trajectory.

        Args:
            num_functions: Number ``k`` of functions.
            seed: Seed of the draw. Default: go on with PyTorch's generator.

        Returns:
            A deterministic function of states ``k x N x state_dim`` and actions
            ``k x N x action_dim`` to next states, each of the ``k`` blocks by its own draw. Later
            updates leave it as it is.
        """

    def sample(self, states: Tensor, actions: Tensor) -> Tensor:
        """Draw next states, ``N x state_dim``, by default each entry from its own Gaussian."""
        mean, variance = self.predict(states, actions)
        return mean + variance.sqrt() * torch.randn_like(mean)

    def mean_function(self) -> TransitionFunctions:
        """Return the mean of predictions, a function of any ``k`` blocks as a sampled one."""
        return lambda states, actions: self.predict(states, actions).mean

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return the variance of measured next states about a sampled function, by default 0."""
        return torch.zeros_like(states)

    def noise_root(self) -> Tensor | None:
        """Return a lower triangular root of the correlation of predicted states' noise, if any."""
        return None

    def before_data(self) -> Dynamics | None:
        """Return dynamics to use before there are transitions; None if nothing is known."""
        return self if self.is_fitted else self.physics_alone()

    def physics_alone(self) -> Dynamics | None:
        """Return the physics by itself, whatever was learnt; by default, and of several, None."""
        return None

    def try_physics(self, states: Tensor, actions: Tensor) -> None:
        """Raise the error of a physics that is wrong, before there are transitions."""
        dynamics = self.before_data()
        if dynamics is not None:
            dynamics.predict(states, actions)

    def score(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Scores:
        r"""Judge the predictions by transitions that were not learnt from.

        The outputs are the states that move, in the spec's order. The variance of an integrated
        state is :math:`(h / 2)^2` times that of its velocity: the more certain the velocity, the
        more the trapezoid's own error counts in its ``nlpd`` and ``coverage``. Of a state that has
        a variance of zero, which says nothing of errors, there are ``rmse`` and ``median`` only.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
            next_states: ``N x state_dim``; NaN where an entry was not measured.

        Raises:
            RuntimeError: If nothing was learnt yet.
            TypeError: If they are not float64 tensors.
            ValueError: If shapes disagree or values are not finite.
        """
        data = Trajectories.checked(self.spec, states, actions, next_states)
        moving = self.spec.moving
        mean, variance = self.predict(data.states, data.actions)
        measured = mean + self.spec.change(mean, data.next_states)  # angles the shortest way round
        mean, variance, measured = (part[:, moving] for part in (mean, variance, measured))
        variance = variance.masked_fill((variance <= 0).any(0), torch.nan)
        names = [self.spec.states[i] for i in moving]
        return Scores.of(mean, variance, measured, output_names=names)

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
        """Follow actions from given states, without looking at what is measured on the way.

        Functions that are drawn from the dynamics follow the actions; see :class:`FreeRun`.
        :meth:`Trajectories.windows` has both, and what ``score`` of the runs is to know.

        Args:
            initial_states: ``w x state_dim``.
            actions: ``w x T x action_dim``.
            num_functions: Number of functions, one for each particle: so many that the interval
                has ends, 39 or more for 95 %.
            level: The probability of the intervals.
            noise: Standard deviations ``state_dim`` of the errors of measured states, of which
                intervals and particles are; True for the noise that the dynamics learnt (of entries
                that are clearly correlated, jointly), False for the states themselves.
            start_noise: Standard deviations ``state_dim`` of the errors of the initial states.
                ``"learnt"``: half of the variance of the learnt noise, which is right if that comes
                of measuring both ends of a transition. Default: they are exact.
            process_noise: Standard deviations ``state_dim`` of what each step adds to the state
                itself, so that it is carried on. ``"learnt"``: the learnt noise, which is that if
                they learnt from states without noise, such as :func:`smooth` draws. Default: none.
            variation: Standard deviations by which the physics' unknown parameters differ in a run
                from those that were learnt, one for each or one for all, in those of their priors:
                ``smoothed.variation`` of :func:`smooth`; more for another machine. Each particle
                keeps its own. Under actions beyond those that were learnt from they are larger:
                three times, where it is by half of their range, but no more than half of the
                prior's. Default: none.
            state_bounds: Lower and upper bounds, ``2 x state_dim``, as of a task: a particle that
                would leave them stays where it is. Default: none.
            seed: Seed of functions and noise; PyTorch's generator is left as it is.

        Raises:
            RuntimeError: If nothing was learnt yet.
            TypeError: If states or actions are not float64 tensors.
            ValueError: If shapes disagree, values are not finite, or an option is out of range.
            PhysicsError: If the physics fails and does not say where.
        """
        spec = self.spec
        _check_start(spec, initial_states, actions)
        _check_enough(num_functions, level)
        start = _checked_noise(spec, "start_noise", start_noise)
        process = _checked_noise(spec, "process_noise", process_noise)
        sensors = _checked_noise(spec, "noise", noise)
        if isinstance(sensors, str) and isinstance(process, str):
            raise ValueError(
                "The learnt noise moves particles on (process_noise='learnt'), so that it is not "
                "that of measurements as well; say the noise of these, such as "
                "noise=smoothed.noise of smooth(records, physics), or noise=False."
            )
        low, high = -math.inf, math.inf
        if state_bounds is not None:
            low, high = of_states(state_bounds, "state_bounds", (2, spec.state_dim))
        sample = self.sample_functions if variation is None else self._varied(variation)
        generator = torch.Generator().manual_seed(seed)

        def scatter(noise: Tensor | str, states: Tensor, actions: Tensor) -> Tensor:
            """Draw noise, given or learnt, at states ``... x state_dim`` for each particle."""
            if isinstance(noise, Tensor):
                return _drawn(spec, noise.expand_as(states), num_functions, generator, None)
            rows = (part.flatten(0, -2).split(_ROWS) for part in (states, actions))
            parts = zip(*rows, strict=True)
            variance = torch.cat([step_or_nan(self.noise_variance, *part) for part in parts])
            sd = _with_lags(spec, variance.sqrt().view_as(states))
            return _drawn(spec, sd, num_functions, generator, self.noise_root())

        def is_off(states: Tensor) -> Tensor:
            return ~(states.isfinite() & (states >= low) & (states <= high)).all(-1)

        # Dynamics of a user's may draw from PyTorch's generator all the same.
        with torch.no_grad(), seeded(seed):
            functions = sample(num_functions, seed)
            particles = initial_states.expand(num_functions, -1, -1)
            if start is not None:
                share = 1.0 if isinstance(start, Tensor) else 0.5
                added = scatter(start, initial_states, actions[:, 0]).nan_to_num()
                particles = particles + share**0.5 * added
            lost = torch.zeros(particles.shape[:2], dtype=torch.bool)
            path, lost_by_then = [], []
            for action in actions.unbind(1):
                after = _moved(functions, particles, action)
                lost = lost | is_off(after)
                if process is not None:
                    added = scatter(process, _center(spec, particles), action).nan_to_num()
                    after[..., spec.moving] += added[..., spec.moving]
                    lost = lost | is_off(after)
                particles = torch.where(lost.unsqueeze(-1), particles, after)
                path.append(particles)
                lost_by_then.append(lost.double().mean(0))
            particles = torch.stack(path, dim=2)
            center = _center(spec, particles)
            cloud = spec.change(center.expand_as(particles), particles)
            center = without_jumps(spec, initial_states, center)
            mean = center + cloud.mean(0)
            if sensors is not None:
                before = torch.cat([initial_states.unsqueeze(1), mean[:, :-1]], dim=1)
                cloud = cloud + scatter(sensors, before, actions)
        lower, upper = (center + end for end in central_interval(cloud, level))
        shares = torch.stack(lost_by_then, 1)
        return FreeRun(mean, lower, upper, center + cloud, shares, spec, level, initial_states)

    def _varied(
        self, variation: Tensor | float
    ) -> Callable[[int, int | None], TransitionFunctions]:
        """Return `sample_functions`, each function with parameters of its own."""
        raise ValueError(
            "Expected LearnedDynamics that learnt unknown parameters of one physics, which are to "
            f"differ by variation={variation!r}; found {type(self).__name__}, or several physics."
        )

    def describe(self) -> dict[str, str]:
        """Return each setting of these dynamics as a text; by default, class and spec."""
        return fingerprint(type(self), self.spec)

    def state_dict(self) -> dict[str, Any]:
        """Return all that was learnt, in tensors and plain values; without physics and spec.

        A class of your own that does not implement it raises a NotImplementedError.
        """
        raise NotImplementedError(_NOT_SAVED.format(type(self).__name__))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take back what :meth:`state_dict` gave; predictions and later fits are the same."""
        raise NotImplementedError(_NOT_SAVED.format(type(self).__name__))

    def _checked(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Trajectories:
        """Return transitions that are what the spec says."""
        data = Trajectories.checked(self.spec, states, actions, next_states)
        self.spec.check_transitions(*data)
        return data

    def _check_blocks(self, states: Tensor, actions: Tensor, number: int | None = None) -> None:
        """Raise an error unless states have actions, in as many blocks as there are functions."""
        check_doubles("states", states, self.spec.state_dim)
        check_columns("actions", actions, self.spec.action_dim)
        lead = zip(reversed(actions.shape[:-1]), reversed(states.shape[:-1]), strict=False)
        if actions.dim() > states.dim() or any(own not in (1, other) for own, other in lead):
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
    r"""Predicted states along ``w`` sequences of ``T`` actions, each from its own state.

    Step t is the state after t + 1 actions. Each of the ``K`` particles follows one function drawn
    from the dynamics. Noise is added to what is reported of each step, as to a measurement of it,
    and moves nothing on; process noise moves the particles themselves. A particle that would leave
    the bounds or the finite numbers, or meet a failure of the physics, is lost: it stays.

    The mean of an angle is that on the circle. It goes on from the initial state without jumps of
    :math:`2 \pi`, and interval and particles of each step are about it: compare with what was
    measured by ``spec.change(run.mean, measured)``.

    Args:
        mean: ``w x T x state_dim``.
        lower: What a state is above with probability ``(1 + level) / 2``, ``w x T x state_dim``: an
            order statistic of the particles, which holds for any distribution. NaN where the noise
            is not known, as the physics fails at the mean before.
        upper: What it is below with that probability.
        particles: ``K x w x T x state_dim``; without noise, an angle is within half a turn of the
            mean.
        lost: Share of the particles that are lost by then, ``w x T``.
        spec: What the entries of states are.
        level: The probability of the intervals.
        initial_states: Where the runs start, ``w x state_dim``.

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
        """Judge the runs by what was measured of states that were not learnt from.

        Scores are over all windows, ``T x state_dim``; ``scores[t]`` are those after t + 1 steps.
        Angles are compared the shortest way round. What was measured has noise: so should the
        runs, as they do by default. The predicted distribution is the Gaussian with the particles'
        mean and variance (with 39 particles its ``nlpd`` is some 0.03 nats too high), coverage that
        of the interval. States in which the particles of a window have no spread, which says
        nothing of errors, have ``rmse`` and ``median`` only. Of an unstable system a few runs that
        fall to the other side make up most of a mean square: look at the median. ``energy`` is of
        all states that move together.

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
        """
        spec, length = self.spec, self.mean.shape[1]
        check_doubles("measured", measured, spec.state_dim)
        if measured.shape != self.mean.shape:
            raise ValueError(
                f"Expected measured of shape w x T x state_dim {tuple(self.mean.shape)}, that of "
                f"the runs' means, got {tuple(measured.shape)}; of `windows` that the runs start "
                "from it is `windows.measured`."
            )
        if measured.isinf().any():
            raise ValueError("Expected measured to be finite, or NaN where it was not measured.")
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
        variance = self.particles.var(0)
        range_of_means = self.mean.amax((0, 1)) - self.mean.amin((0, 1))
        silent = (variance.sqrt() <= _CERTAIN * range_of_means).any(0)
        variance = variance.masked_fill(silent, torch.nan)
        measured = self.mean + spec.change(self.mean, measured)
        parts = self.mean, variance, measured, self.lower, self.upper, self.particles
        rows = torch.tensor(steps) - 1  # step by step: ... x H x w x state_dim
        mean, variance, measured, *ends, draws = (
            part[..., rows, :].transpose(-3, -2) for part in parts
        )
        draws, y = ((part / units)[..., spec.moving] for part in (draws, measured))
        y = y.masked_fill(draws.isnan().any(0), torch.nan)  # where the physics fails
        return Scores.of(
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
    """Return the next states ``N x state_dim``; not finite where the physics fails.

    A PhysicsError is raised if it does not say where, or everywhere and ``some_must_succeed``.
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
    """Return the mean of particles ``K x ... x state_dim``, of angles that on the circle."""
    center = particles.mean(0)
    for i in spec.angle_columns:
        angle = particles[..., i]
        center[..., i] = torch.atan2(angle.sin().mean(0), angle.cos().mean(0))
    return center


def without_jumps(spec: StateSpec, initial_states: Tensor, path: Tensor) -> Tensor:
    """Return a path ``w x T x state_dim`` whose angles go on from those of the initial states."""
    path, angles = path.clone(), spec.angle_columns
    before = torch.cat([initial_states.unsqueeze(1), path[:, :-1]], dim=1)
    change = spec.change(before, path)[..., angles]
    path[..., angles] = before[:, :1, angles] + change.cumsum(1)
    return path


def _with_lags(spec: StateSpec, noise: Tensor) -> Tensor:
    """Return noise ``... x state_dim`` of measured states, whose lags were measured alike."""
    noise = noise.clone()
    for name, held in spec.previous.items():
        while held in spec.previous:
            held = spec.previous[held]
        if held in spec.states:
            noise[..., spec.states.index(name)] = noise[..., spec.states.index(held)]
    return noise


def _drawn(
    spec: StateSpec, sd: Tensor, number: int, generator: torch.Generator, root: Tensor | None
) -> Tensor:
    """Draw noise ``number x ... x state_dim``; an integrated state has that of its velocity."""
    z = torch.randn(number, *sd.shape, generator=generator, dtype=torch.float64)
    if root is not None:
        z[..., spec.predicted] = z[..., spec.predicted] @ root.mT
    for name, velocity in spec.integrated.items():
        z[..., spec.states.index(name)] = z[..., spec.states.index(velocity)]
    return sd * z


def central_interval(sample: Tensor, level: float) -> tuple[Tensor, Tensor]:
    """Return the ends between which a further draw lies with this probability, of ``K x ...``.

    It is below the i-th smallest of K with probability i / (K + 1), and linear in between.
    """
    ordered, ends = sample.sort(0).values, []
    for probability in ((1 - level) / 2, (1 + level) / 2):
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
    """Raise an error unless each state has a sequence of actions, all of them finite."""
    check_doubles("initial_states", initial_states, spec.state_dim)
    check_doubles("actions", actions, spec.action_dim)
    fits = initial_states.dim() == 2 and actions.dim() == 3 and len(initial_states) == len(actions)
    if not fits or not actions.numel():
        raise ValueError(
            f"Expected initial_states of shape w x {spec.state_dim} and actions of shape w x T x "
            f"{spec.action_dim}, one sequence of one or more actions for each state, got "
            f"{tuple(initial_states.shape)} and {tuple(actions.shape)}; of a single run, use "
            "`initial_state.unsqueeze(0)` and `actions.unsqueeze(0)`."
        )
    check_finite("initial_states", initial_states)
    check_finite("actions", actions)


def _check_enough(num_functions: int, level: float) -> None:
    """Raise an error unless so many particles have an interval of this probability."""
    check_level(level)
    least = math.ceil(round(2 / (1 - level), 9)) - 1  # whose outermost two are its ends
    if checked_whole("num_functions", num_functions, 1) < least:
        raise ValueError(
            f"Expected num_functions >= {least}, without which there are no ends of an "
            f"interval of {100 * level:g} %, got {num_functions}."
        )


def _checked_noise(spec: StateSpec, name: str, noise: Any) -> Tensor | Literal["learnt"] | None:
    """Return standard deviations ``state_dim``, "learnt" or None."""
    off, learnt = (False, True) if name == "noise" else (None, "learnt")
    if noise is off:
        return None
    if isinstance(noise, str | bool):
        if noise == learnt:
            return "learnt"
        words = f"{learnt!r} or {off}" if name == "noise" else repr(learnt)
        raise ValueError(f"Expected {name} as {words} or a tensor, got {noise!r}.")
    sd = of_states(noise, name, (spec.state_dim,))
    if not (sd.isfinite() & (sd >= 0)).all():
        raise ValueError(
            f"Expected {name} of 0 or more, got {sd.tolist()}; of states that are never measured "
            "`.nan_to_num()` makes it 0."
        )
    return sd


def checked_horizons(horizons: Sequence[int]) -> tuple[int, ...]:
    """Return numbers of steps in order; an error unless they are different, and at least 1."""
    is_list = isinstance(horizons, Sequence) and len(horizons) > 0
    if not is_list or len({*horizons}) < len(horizons):
        raise ValueError(
            "Expected horizons as different numbers of steps, such as (1, 5, 15), got "
            f"{horizons!r}."
        )
    return tuple(sorted(checked_whole("each horizon", each, 1) for each in horizons))


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
