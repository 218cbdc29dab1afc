"""Environments seen otherwise: with previous actions, through noisy sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from gpadjust.checks import checked_number, checked_whole
from gpadjust.states import StateSpec

Array = NDArray[np.float32]


class RememberAction(gym.Wrapper[Array, Array, Array, Array], gym.utils.RecordConstructorArgs):
    """Appends the actions that were taken last to the observation, the newest first.

    At the start of an episode they are zeros. Where a system follows its actions with a delay that
    the observation does not show, such as the activation of muscles, the next observation depends
    on earlier actions. A :class:`~gpadjust.states.StateSpec` declares them in ``previous``, such as
    ``{"force_1": "force", "force_2": "force_1"}`` of two steps.

    What is appended is the action clipped to its space, as the environments of this library take
    it. Observations keep their data type, if that is floating-point.

    Args:
        env: An environment whose observations and actions are boxes of one dimension; zero is an
            action.
        steps: How many actions it remembers.

    Raises:
        TypeError: If ``steps`` is no whole number.
        ValueError: If spaces or ``steps`` are others.

    Example:
        >>> import gymnasium
        >>> from gpadjust.systems import RememberAction
        >>> env = RememberAction(gymnasium.make("gpadjust/CartPoleSwingUp-v0"))
        >>> _ = env.reset(seed=0)
        >>> observation, *_ = env.step(np.array([3.0], dtype=np.float32))
        >>> observation[-1]
        np.float32(3.0)
    """

    def __init__(self, env: gym.Env[Array, Array], *, steps: int = 1) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, steps=steps)
        gym.Wrapper.__init__(self, env)
        self._steps = checked_whole("steps", steps, 1)
        seen, taken = env.observation_space, env.action_space
        for name, space in (("observation", seen), ("action", taken)):
            if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
                raise ValueError(
                    f"RememberAction needs an {name} space that is a Box of one dimension; found "
                    f"{space}. Put gymnasium.wrappers.FlattenObservation or RescaleAction inside."
                )
        assert isinstance(seen, gym.spaces.Box), "checked above"
        assert isinstance(taken, gym.spaces.Box), "checked above"
        self._taken = taken
        self._last = np.zeros((steps, *taken.shape), dtype=taken.dtype)
        if not taken.contains(self._last[0]):
            raise ValueError(
                f"RememberAction starts from the action zero, which is not in {taken}. Put "
                "gymnasium.wrappers.RescaleAction inside."
            )
        floating = np.issubdtype(seen.dtype, np.floating)
        # Integers could not hold the action.
        self._dtype = seen.dtype if floating else np.result_type(seen.dtype, taken.dtype)
        self.observation_space = gym.spaces.Box(
            self._extended(seen.low, np.tile(taken.low, steps)),
            self._extended(seen.high, np.tile(taken.high, steps)),
            dtype=self._dtype.type,
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode; its first observation ends with zeros."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._last = np.zeros_like(self._last)
        return self._extended(observation, self._last), info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Take an action; the observation ends with it, clipped, and those before it."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        taken = np.clip(action, self._taken.low, self._taken.high)
        self._last = np.concatenate([taken[None], self._last[:-1]]).astype(self._last.dtype)
        extended = self._extended(observation, self._last)
        return extended, float(reward), terminated, truncated, info

    def _extended(self, observation: Array, actions: Array) -> Array:
        return np.concatenate([observation, actions.ravel()]).astype(self._dtype)


class NoisySensors(gym.ObservationWrapper[Array, Array, Array], gym.utils.RecordConstructorArgs):
    """Adds normal noise to the states that an environment observes; rewards are of the true state.

    Args:
        env: The environment, which observes the states of the spec.
        spec: What they are; an angle gets its noise before its sine and cosine are taken.
        sd: Standard deviations by the name of the state; the others have no noise.

    Raises:
        TypeError: If a standard deviation is no number.
        ValueError: If one is negative, or there is no such state.

    Example:
        >>> from gpadjust import systems
        >>> env = systems.cart_pole(noise={"x": 0.01, "theta": 0.02}).make()
        >>> _ = env.reset(seed=0)
    """

    def __init__(
        self, env: gym.Env[Array, Array], spec: StateSpec, sd: Mapping[str, float]
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, spec=spec, sd=dict(sd))
        gym.ObservationWrapper.__init__(self, env)
        self.spec_of_states = spec
        for name, value in sd.items():
            checked_number(f"The noise of {name!r}", value, least=0)
            if name not in spec.states:
                raise ValueError(f"There is no state {name!r}; the states are {spec.states}.")
        self._columns = [i for i, name in enumerate(spec.states) if name in sd]
        self._sd = np.array([sd[spec.states[i]] for i in self._columns])

    def observation(self, observation: Array) -> Array:
        """Add the noise, by the environment's generator."""
        spec = self.spec_of_states
        state = spec.decode(torch.from_numpy(observation.astype(np.float64)))
        noise = self._sd * self.unwrapped.np_random.normal(size=len(self._sd))
        state[self._columns] += torch.from_numpy(noise)
        return spec.observe(state).numpy().astype(observation.dtype)
