"""Wrappers of environments: previous actions, and noisy sensors."""

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
    """Appends the last actions to the observation, the newest first, beginning with zeros.

    For systems that follow their actions with a delay. A :class:`~gpadjust.states.StateSpec`
    declares them in ``previous``, such as ``{"force_1": "force", "force_2": "force_1"}`` for two
    steps. Actions are clipped to their space.

    Args:
        env: An environment whose observations and actions are boxes of one dimension, with zero as
            an action.
        steps: The number of actions.

    Raises:
        TypeError, ValueError: If ``steps`` is not a positive whole number, or a space is another.

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
        observations: Any = env.observation_space
        actions: Any = env.action_space
        for name, space in (("observation", observations), ("action", actions)):
            if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
                raise ValueError(
                    f"RememberAction needs an {name} space that is a Box of one dimension; found "
                    f"{space}. Put gymnasium.wrappers.FlattenObservation or RescaleAction inside."
                )
        self._actions = actions
        self._last = np.zeros((steps, *actions.shape), dtype=actions.dtype)
        if not actions.contains(self._last[0]):
            raise ValueError(
                f"RememberAction starts from the action zero, which is not in {actions}. Put "
                "gymnasium.wrappers.RescaleAction inside."
            )
        # The space of the observation, followed by that of the actions.
        dtype = np.result_type(observations.dtype, actions.dtype).type
        low = np.concatenate([observations.low, np.tile(actions.low, steps)], dtype=dtype)
        high = np.concatenate([observations.high, np.tile(actions.high, steps)], dtype=dtype)
        self.observation_space = gym.spaces.Box(low, high, dtype=dtype)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode; its first observation ends with zeros."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._last = np.zeros_like(self._last)
        return self._extended(observation), info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Take an action; the observation ends with the clipped action and earlier ones."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        clipped = np.clip(action, self._actions.low, self._actions.high)
        self._last = np.concatenate([clipped[None], self._last[:-1]]).astype(self._last.dtype)
        return self._extended(observation), float(reward), terminated, truncated, info

    def _extended(self, observation: Array) -> Array:
        dtype = self.observation_space.dtype
        return np.concatenate([observation, self._last.ravel()]).astype(dtype)


class NoisySensors(gym.ObservationWrapper[Array, Array, Array], gym.utils.RecordConstructorArgs):
    """Observations by sensors with normal noise; rewards are those of the true state.

    Args:
        env: The environment, whose observations are the states of the spec.
        spec: The states; noise is added to an angle, not to its sine and cosine.
        sd: Standard deviations by the name of the state or output; the others have no noise.
        sensors: The measured outputs. Default: all states.

    Raises:
        TypeError, ValueError: If a standard deviation is not a number of 0 or more, or a state or
            output does not exist.

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
        self._outputs = self.sensors.spec(spec)
        for name, value in sd.items():
            checked_number(f"The noise of {name!r}", value, least=0)
            if name not in self.sensors.outputs:
                noun = "state" if sensors is None else "output"
                raise ValueError(
                    f"There is no {noun} {name!r}; the {noun}s are {self.sensors.outputs}."
                )
        values = [sd.get(name, 0.0) for name in self.sensors.outputs]
        self._sd = torch.tensor(values, dtype=torch.float64)
        if sensors is not None:  # a space without the hidden states
            dtype: Any = env.observation_space.dtype
            shape = (self._outputs.observation_dim,)
            self.observation_space = gym.spaces.Box(-np.inf, np.inf, shape, dtype)

    def observation(self, observation: Array) -> Array:
        """Return the measured outputs, with noise from the environment's generator."""
        # From sine and cosine back to angles, for the noise.
        states = self.spec_of_states.decode(torch.from_numpy(observation.astype(np.float64)))
        values = self.sensors.measure(self.spec_of_states, states.unsqueeze(0)).squeeze(0)
        # Outputs without noise draw no number.
        is_noisy = self._sd > 0
        noise = torch.from_numpy(self.unwrapped.np_random.normal(size=int(is_noisy.sum())))
        values = values.clone()
        values[is_noisy] += self._sd[is_noisy] * noise
        return self._outputs.observe(values).numpy().astype(observation.dtype)
