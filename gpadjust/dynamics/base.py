"""The interface of a dynamics model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from gpadjust.checks import check_columns, check_level, seeded
from gpadjust.core import Prediction
from gpadjust.dynamics.free_run import (
    FreeRun,
    about_center,
    central_interval,
    check_enough,
    check_start,
    checked_noise,
    measurement_noise,
    move_on,
    of_states,
    step_or_nan,
    with_lags,
    without_jumps,
)
from gpadjust.dynamics.state import fingerprint
from gpadjust.dynamics.targets import check_spec
from gpadjust.dynamics.trajectories import Trajectories, check_doubles
from gpadjust.states import StateSpec
from gpadjust.validation import Scores

_ROWS = 1024  # whose noise is asked for at once
TransitionFunctions = Callable[[Tensor, Tensor], Tensor]
"""Functions from states and actions, ``k x N x ...``, to next states: a sample of the dynamics."""


class Dynamics(ABC):
    """A distribution of the next state, given a state and an action.

    All tensors are float64 and in the user's units: states ``N x state_dim``, actions
    ``N x action_dim``, see :class:`StateSpec`. Angles need not be wrapped.

    Args:
        spec: What the entries of states and actions are.

    Raises:
        TypeError: If ``spec`` is not a :class:`StateSpec`.
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
        """Mean and variance of the next states, ``N x state_dim`` each, entry by entry."""

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
        """Draw next states, ``N x state_dim``, row by row, from PyTorch's generator.

        Unless dynamics say something else, each entry from its own normal distribution.
        """
        mean, variance = self.predict(states, actions)
        return mean + variance.sqrt() * torch.randn_like(mean)

    def mean_function(self) -> TransitionFunctions:
        """The mean of the predictions, as a function of any ``k`` blocks; see `sample_functions`.

        Later updates leave it as it is.
        """
        return lambda states, actions: self.predict(states, actions).mean

    def before_data(self) -> Dynamics | None:
        """Dynamics to use before there are transitions; None if nothing is known of the system."""
        return self if self.is_fitted else None

    def physics_alone(self) -> Dynamics | None:
        """The physics by itself, whatever was learnt; None if there is none, or there are several.

        Unless dynamics say something else, none.
        """
        return None

    def score(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Scores:
        r"""Judge the predictions by transitions that were not learnt from.

        The outputs are the states that move, in the spec's order; exogenous ones and previous
        values are left out. The variance of an integrated state is what the dynamics say,
        :math:`(h / 2)^2` times that of its velocity: the more certain the velocity, the more the
        trapezoid's own error counts in its ``nlpd`` and ``coverage``. Of a state that has a
        variance of zero, which says nothing of errors, there are ``rmse`` and ``median`` only.

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
        # Angles the shortest way round.
        found = (mean + self.spec.change(mean, data.next_states))[:, moving]
        mean, variance = mean[:, moving], variance[:, moving]
        says = variance.masked_fill((variance <= 0).any(0), torch.nan)
        return Scores.of(mean, says, found, output_names=[self.spec.states[i] for i in moving])

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
            noise: Whether intervals and particles are of measured states, with the noise that the
                dynamics learnt (errors of entries that are clearly correlated, jointly), or of the
                states themselves. Or the standard deviations
                ``state_dim`` of the measurements' errors.
            start_noise: Standard deviations ``state_dim`` by which the initial states, as measured,
                err; each particle then starts elsewhere. ``"learnt"``: half of the variance of the
                learnt noise, which is right if that comes of measuring both ends of a transition.
                Default: they are exact.
            process_noise: Standard deviations ``state_dim`` of what each step adds to the state
                itself, so that it is carried on. ``"learnt"``: the noise that the dynamics learnt,
                which is that if they learnt from states without noise, such as those that
                :func:`smooth` draws. Default: nothing.
            variation: Standard deviations by which the physics' unknown parameters differ in a run
                from those that were learnt, one for each or one for all, in those of their priors:
                ``smoothed.variation`` of :func:`smooth`; more for another machine, of which the
                records tell nothing. Each particle keeps its own. Under actions (torques, loads)
                beyond those that were learnt from they are larger: three times, where it is by half
                of their range, but no more than half of the prior's. Default: none.
            state_bounds: Lower and upper bounds, ``2 x state_dim``, as of a task: a particle that
                would leave them stays where it is. Default: none.
            seed: Seed of functions and noise; PyTorch's generator is left as it is.

        Raises:
            RuntimeError: If nothing was learnt yet.
            TypeError: If states or actions are not float64 tensors.
            ValueError: If shapes disagree, values are not finite, or an option is out of range.
            PhysicsError: If the physics fails and does not say where.

        Example:
            >>> import torch
            >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
            >>> spec = StateSpec(["x"], ["v"])
            >>> dynamics = PhysicsDynamics(spec, physics=lambda X: X[:, :1] + 0.1 * X[:, 1:])
            >>> x, v = torch.zeros(1, 1).double(), torch.ones(1, 3, 1).double()
            >>> dynamics.free_run(x, v).mean.flatten()
            tensor([0.1000, 0.2000, 0.3000], dtype=torch.float64)
        """
        sample_functions = self.sample_functions if variation is None else self._varied(variation)
        spec = self.spec
        check_start(spec, initial_states, actions)
        check_level(level)
        check_enough(num_functions, level)
        if state_bounds is not None:
            state_bounds = of_states(state_bounds, "state_bounds", (2, spec.state_dim))
        start_noise, process_noise = (
            checked_noise(spec, given, name)
            for given, name in ((start_noise, "start_noise"), (process_noise, "process_noise"))
        )
        sensors = None if isinstance(noise, bool) else checked_noise(spec, noise, "noise")
        if noise is True and isinstance(process_noise, str):
            raise ValueError(
                "The learnt noise moves particles on (process_noise='learnt'), so that it is not "
                "that of measurements as well; say the noise of these, such as "
                "noise=smoothed.noise of smooth(records, physics), or noise=False."
            )
        generator = torch.Generator().manual_seed(seed)
        learnt = "learnt" in (start_noise, process_noise) or noise is True
        root = self.noise_root() if learnt else None
        roots = [root if isinstance(each, str) else None for each in (start_noise, process_noise)]
        # Dynamics of a user's may draw from PyTorch's generator all the same.
        with torch.no_grad(), seeded(seed):
            functions = sample_functions(num_functions, seed)
            particles = initial_states.expand(num_functions, -1, -1)
            if isinstance(start_noise, str):
                variance = step_or_nan(self.noise_variance, initial_states, actions[:, 0])
                start_noise = with_lags(spec, (variance.nan_to_num(nan=0.0) / 2).sqrt())
            if start_noise is not None:
                error = start_noise.expand_as(initial_states)
                drawn = measurement_noise(spec, error, num_functions, generator, roots[0])
                particles = particles + drawn
            lost = torch.zeros(particles.shape[:2], dtype=torch.bool)
            path, lost_by_then = [], []
            for each in actions.unbind(1):
                before, added = particles, None
                if not isinstance(process_noise, str):
                    added = process_noise
                else:
                    middle = about_center(spec, particles)[0]
                    variance = step_or_nan(self.noise_variance, middle, each)
                    added = variance.nan_to_num(nan=0.0).sqrt()
                particles, lost = move_on(functions, particles, lost, each, state_bounds)
                if added is not None:
                    error = torch.zeros_like(initial_states)
                    error[:, spec.moving] = added.expand_as(initial_states)[:, spec.moving]
                    moved = measurement_noise(spec, error, num_functions, generator, roots[1])
                    particles = particles + moved.masked_fill(lost.unsqueeze(-1), 0.0)
                    if state_bounds is not None:
                        low, high = state_bounds
                        lost = lost | ((particles < low) | (particles > high)).any(-1)
                        particles = torch.where(lost.unsqueeze(-1), before, particles)
                path.append(particles)
                lost_by_then.append(lost.double().mean(0))
            center, cloud = about_center(spec, torch.stack(path, dim=2))
            center = without_jumps(spec, initial_states, center)
            mean = center + cloud.mean(0)
            if isinstance(sensors, Tensor):
                error = sensors.expand_as(center)
                cloud = cloud + measurement_noise(spec, error, num_functions, generator)
            elif noise:
                before = torch.cat([initial_states.unsqueeze(1), mean[:, :-1]], dim=1)
                rows = (each.flatten(0, 1).split(_ROWS) for each in (before, actions))
                parts = zip(*rows, strict=True)
                variances = [step_or_nan(self.noise_variance, *part) for part in parts]
                scatter = with_lags(spec, torch.cat(variances).sqrt().view_as(center))
                cloud = cloud + measurement_noise(spec, scatter, num_functions, generator, root)
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

    def noise_variance(self, states: Tensor, actions: Tensor) -> Tensor:
        """Variance of measured next states about a sampled function, ``N x state_dim``.

        It is what variances of :meth:`predict` have beside those of the functions; zero unless
        dynamics say something else.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
        """
        return torch.zeros_like(states)

    def noise_root(self) -> Tensor | None:
        """Lower triangular root of the correlation of predicted states' noise; None for none."""
        return None

    def _varied(
        self, variation: Tensor | float
    ) -> Callable[[int, int | None], TransitionFunctions]:
        """Like `sample_functions`, each function with parameters of its own."""
        raise ValueError(
            "Expected LearnedDynamics that learnt unknown parameters of one physics, which are to "
            f"differ by variation={variation!r}; found {type(self).__name__}, or several physics."
        )

    def try_physics(self, states: Tensor, actions: Tensor) -> None:
        """Find what is wrong with the physics before there are transitions, if it can be told.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.

        Raises:
            ValueError: If the physics returns another number of states.
            PhysicsError: If the physics fails.
        """
        if self.is_fitted:
            self.predict(states, actions)

    def describe(self) -> dict[str, str]:
        """Each setting of these dynamics as a text; by default, class and spec."""
        return fingerprint(type(self), self.spec)

    def state_dict(self) -> dict[str, Any]:
        """All that was learnt, in tensors and plain values; without physics and spec.

        Raises:
            NotImplementedError: If dynamics of a class of your own do not say it.
        """
        raise NotImplementedError(self._not_saved)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take back what :meth:`state_dict` gave; predictions and later fits are the same."""
        raise NotImplementedError(self._not_saved)

    @property
    def _not_saved(self) -> str:
        return (
            f"{type(self).__name__} cannot be saved or loaded. Give it state_dict() and "
            "load_state_dict(state), or do without checkpoints and sensors."
        )

    def _checked(self, states: Tensor, actions: Tensor, next_states: Tensor) -> Trajectories:
        """Transitions that are what the spec says."""
        data = Trajectories.checked(self.spec, states, actions, next_states)
        self.spec.check_transitions(data.states, data.next_states, data.actions)
        return data

    def _check_pair(self, states: Tensor, actions: Tensor) -> None:
        check_doubles("states", states, self.spec.state_dim)
        check_columns("actions", actions, self.spec.action_dim)
        lead = zip(reversed(actions.shape[:-1]), reversed(states.shape[:-1]), strict=False)
        if actions.dim() > states.dim() or any(own not in (1, other) for own, other in lead):
            raise ValueError(
                "Expected an action for each state, or one for all, got states of shape "
                f"{tuple(states.shape)} and actions of shape {tuple(actions.shape)}."
            )

    def _check_blocks(self, states: Tensor, actions: Tensor, num_functions: int) -> None:
        self._check_pair(states, actions)
        if states.dim() != 3 or len(states) != num_functions:
            raise ValueError(
                f"Expected states of shape {num_functions} x N x {self.spec.state_dim}, a block "
                f"for each function, got {tuple(states.shape)}."
            )
