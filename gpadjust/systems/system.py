"""A system to control: environment, physics and task in one object."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from torch import Tensor

from gpadjust.checks import check_kind
from gpadjust.physics import Physics, Unknown, as_physics
from gpadjust.states import Sensors, StateSpec
from gpadjust.systems.wrappers import NoisySensors

if TYPE_CHECKING:
    from gpadjust.control import Task
    from gpadjust.dynamics import Dynamics


_OF_TASK = (
    *("terminated", "episode_length", "state_bounds", "sensors", "reference", "constraints"),
    *("probability", "action_rate"),
)


@dataclass(frozen=True, eq=False)
class System:
    """A system to control: the real one as an environment, its physics, reward and task.

    Args:
        env: Makes the environment, such as its class; it gets the keyword arguments of
            :meth:`make`.
        spec: The entries of states and actions.
        physics: f_p, the next values of the states that are neither exogenous nor previous values,
            from these and the actions, or from ``spec.physics_reads``; unknown parameters are
            possible.
        reward: A function of states ``N x state_dim``, actions ``N x action_dim`` and next states
            ``N x state_dim`` to rewards ``N``.
        start: Draws ``n`` initial states of episodes, ``n x state_dim``. Default: the initial
            states of real episodes.
        terminated: A function of states ``N x state_dim`` to ``N`` booleans: the end of an episode.
        episode_length: Steps after which an episode is truncated, at most the time limit of the
            environment. Default: the time limit of the environment.
        state_bounds, reference, constraints, probability, action_rate: As of a
            :class:`~gpadjust.control.Task`.
        physics_error: As of :class:`~gpadjust.dynamics.LearnedDynamics`, for the dynamics of
            :meth:`task`.
        noise: Standard deviations of the sensors' noise, by the name of the state or output, which
            :class:`NoisySensors` adds to the observations.
        sensors: The measured outputs, as of a :class:`~gpadjust.control.Task`. ``env`` observes the
            states, from which :meth:`make` computes the outputs, or the outputs alone. Default: all
            states.

    Raises:
        TypeError: If ``env``, ``physics`` or ``reward`` is not callable, or ``spec``, ``sensors``
            or ``physics_error`` has another type.

    Example:
        >>> from gpadjust import systems
        >>> cart_pole = systems.cart_pole()
        >>> env, task = cart_pole.make(), cart_pole.task()
        >>> task.dynamics.spec.states
        ('x', 'theta', 'x_dot', 'theta_dot')
    """

    env: Callable[..., gym.Env[Any, Any]]
    spec: StateSpec
    physics: Physics | Callable[[Tensor], Tensor]
    reward: Callable[[Tensor, Tensor, Tensor], Tensor]
    _: KW_ONLY
    start: Callable[[int], Tensor] | None = None
    terminated: Callable[[Tensor], Tensor] | None = None
    episode_length: int | None = None
    state_bounds: Tensor | None = None
    reference: Callable[[Tensor, Tensor], Tensor] | None = None
    constraints: Callable[[Tensor, Tensor], Tensor] | None = None
    probability: float | None = 0.95
    action_rate: Any = None
    physics_error: Mapping[str, float] | None = None
    noise: Mapping[str, float] | None = None
    sensors: Sensors | None = None

    def __post_init__(self) -> None:
        """Check the parts that a task does not check."""
        check_kind("spec", self.spec, StateSpec, "a StateSpec")
        for name, hint in (("env", ", its class or `lambda: env`"), ("reward", "")):
            if not callable(getattr(self, name)):
                raise TypeError(f"{name} must be a function{hint}; found {getattr(self, name)!r}.")
        check_kind("sensors", self.sensors, Sensors | None, 'such as Sensors(["x", "theta"])')
        expected = "standard deviations by the name of the state"
        check_kind("physics_error", self.physics_error, Mapping | None, expected)
        # A function becomes a Physics, so that tasks share its memory.
        object.__setattr__(self, "physics", as_physics(self.physics))

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """The unknown parameters of the physics, by name."""
        return as_physics(self.physics).unknowns

    def make(self, **options: Any) -> gym.Env[Any, Any]:
        """Make an environment by arguments of ``env``, truncated after ``episode_length`` steps.

        Raises:
            ValueError: If the time limit of the environment is less than ``episode_length``, or
                its observations are neither the states nor the outputs of the sensors.
        """
        env = self.env(**options)
        limit = env.spec and env.spec.max_episode_steps
        if self.episode_length is not None and limit and limit < self.episode_length:
            raise ValueError(
                f"episode_length must be at most the environment's own time limit, {limit} steps; "
                f"found {self.episode_length}. Raise the limit, or leave episode_length out."
            )
        if self.episode_length not in (None, limit):
            env = gym.wrappers.TimeLimit(env, self.episode_length)
        if self.sensors is None and not self.noise:
            return env
        # Observations are the states, or already the outputs of the sensors.
        states = self.spec.observation_dim
        shape = env.observation_space.shape
        if self.sensors is not None and shape != (states,):
            outputs = self.sensors.spec(self.spec).observation_dim
            if shape == (outputs,) and not self.noise:
                return env
            raise ValueError(
                f"The environment must observe the states ({states} entries), or without `noise` "
                f"the outputs alone ({outputs} entries); found {env.observation_space}."
            )
        return NoisySensors(env, self.spec, self.noise or {}, self.sensors)

    def task(self, dynamics: Dynamics | None = None) -> Task:
        """Return the task, by default with new :class:`~gpadjust.dynamics.LearnedDynamics`.

        Updates change the dynamics: each run needs new ones.
        """
        # Not at the top: an environment alone is quick to import.
        from gpadjust.control import Task
        from gpadjust.dynamics import LearnedDynamics

        if dynamics is None:
            dynamics = LearnedDynamics(self.spec, self.physics, physics_error=self.physics_error)
        options = {name: getattr(self, name) for name in _OF_TASK}
        return Task(dynamics, self.reward, initial_states=self.start, **options)
