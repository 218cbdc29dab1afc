"""Environments with previous actions, or as sensors show them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from gpadjust.checks import checked_number, checked_whole
from gpadjust.states import Sensors, StateSpec

Array = NDArray[np.float32]


class RememberAction(gym.Wrapper[Array, Array, Array, Array], gym.utils.RecordConstructorArgs):
    """Appends the last actions to the observation, the newest first; at first they are zeros.

    Where a system follows its actions with a delay that the observation does not show, such as the
    activation of muscles, the next observation depends on earlier actions. A
    :class:`~gpadjust.states.StateSpec` declares them in ``previous``, such as
    ``{"force_1": "force", "force_2": "force_1"}`` of two steps. Actions are clipped to their space,
    as the environments of this library take them.

    Args:
        env: An environment whose observations and actions are boxes of one dimension; zero is an
            action.
        steps: The number of actions.

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
        checked_whole("steps", steps, 1)
        seen: Any = env.observation_space
        taken: Any = env.action_space
        for name, space in (("observation", seen), ("action", taken)):
            if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
                raise ValueError(
                    f"RememberAction needs an {name} space that is a Box of one dimension; found "
                    f"{space}. Put gymnasium.wrappers.FlattenObservation or RescaleAction inside."
                )
        self._taken = taken
        self._last = np.zeros((steps, *taken.shape), dtype=taken.dtype)
        if not taken.contains(self._last[0]):
            raise ValueError(
                f"RememberAction starts from the action zero, which is not in {taken}. Put "
                "gymnasium.wrappers.RescaleAction inside."
            )
        dtype = np.result_type(seen.dtype, taken.dtype).type
        low = np.concatenate([seen.low, np.tile(taken.low, steps)], dtype=dtype)
        high = np.concatenate([seen.high, np.tile(taken.high, steps)], dtype=dtype)
        self.observation_space = gym.spaces.Box(low, high, dtype=dtype)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode; its first observation ends with zeros."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._last = np.zeros_like(self._last)
        return self._extended(observation), info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Take an action; the observation ends with it, clipped, and those before it."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        taken = np.clip(action, self._taken.low, self._taken.high)
        self._last = np.concatenate([taken[None], self._last[:-1]]).astype(self._last.dtype)
        return self._extended(observation), float(reward), terminated, truncated, info

    def _extended(self, observation: Array) -> Array:
        dtype = self.observation_space.dtype
        return np.concatenate([observation, self._last.ravel()]).astype(dtype)


class NoisySensors(gym.ObservationWrapper[Array, Array, Array], gym.utils.RecordConstructorArgs):
    """Shows what sensors measure of the states, with normal noise; rewards are of the true state.

    Args:
        env: The environment, which observes the states of the spec.
        spec: The states; an angle gets its noise before its sine and cosine are taken.
        sd: Standard deviations by the name of the state or output; the others have no noise.
        sensors: The outputs that are measured. Default: all of the states.

    Raises:
        TypeError: If a standard deviation is no number.
        ValueError: If one is negative, or there is no such state or output.

    Example:
        >>> from gpadjust import systems
        >>> env = systems.cart_pole(noise={"x": 0.01, "theta": 0.02}).make()
        >>> _ = env.reset(seed=0)
    """

    def __init__(
        self,
        env: gym.Env[Array, Array],
        spec: StateSpec,
        sd: Mapping[str, float],
        sensors: Sensors | None = None,
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, spec=spec, sd=dict(sd), sensors=sensors)
        gym.ObservationWrapper.__init__(self, env)
        self.spec_of_states = spec
        self.sensors = Sensors(spec.states) if sensors is None else sensors
        self._seen = self.sensors.spec(spec)
        for name, value in sd.items():
            checked_number(f"The noise of {name!r}", value, least=0)
            if name not in self.sensors.outputs:
                what = "state" if sensors is None else "output"
                raise ValueError(
                    f"There is no {what} {name!r}; the {what}s are {self.sensors.outputs}."
                )
        each = [sd.get(name, 0.0) for name in self.sensors.outputs]
        self._sd = torch.tensor(each, dtype=torch.float64)
        if sensors is not None:
            dtype: Any = env.observation_space.dtype
            shape = (self._seen.observation_dim,)
            self.observation_space = gym.spaces.Box(-np.inf, np.inf, shape, dtype)

    def observation(self, observation: Array) -> Array:
        """Measure, and add the noise by the environment's generator."""
        states = self.spec_of_states.decode(torch.from_numpy(observation.astype(np.float64)))
        values = self.sensors.measure(self.spec_of_states, states.unsqueeze(0)).squeeze(0)
        noisy = self._sd > 0
        noise = torch.from_numpy(self.unwrapped.np_random.normal(size=int(noisy.sum())))
        values = values.clone()
        values[noisy] += self._sd[noisy] * noise
        return self._seen.observe(values).numpy().astype(observation.dtype)
