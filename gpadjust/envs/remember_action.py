"""Observations that hold the previous action."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


class RememberAction(gym.Wrapper[Array, Array, Array, Array], gym.utils.RecordConstructorArgs):
    """Appends the action that was taken last to the observation; zeros at the start of an episode.

    Where a system follows its actions with a delay that the observation does not show, such as the
    activation of muscles, the next observation depends on earlier actions. The last one says much
    of what is hidden. A :class:`~gpadjust.states.StateSpec` declares it in ``previous``. It is that
    action alone: a spec that holds earlier ones, or earlier states, is of an environment that
    observes them itself.

    What is appended is the action clipped to its space, as the environments of this library take
    it. Observations keep their data type, if that is floating-point.

    Args:
        env: An environment whose observations and actions are boxes of one dimension; zero is an
            action.

    Raises:
        ValueError: If they are not.

    Example:
        >>> import gymnasium
        >>> from gpadjust.envs import RememberAction
        >>> env = RememberAction(gymnasium.make("gpadjust/CartPoleSwingUp-v0"))
        >>> _ = env.reset(seed=0)
        >>> observation, *_ = env.step(np.array([3.0], dtype=np.float32))
        >>> observation[-1]
        np.float32(3.0)
    """

    def __init__(self, env: gym.Env[Array, Array]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
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
        self._start = np.zeros(taken.shape, dtype=taken.dtype)
        if not taken.contains(self._start):
            raise ValueError(
                f"RememberAction starts from the action zero, which is not in {taken}. Put "
                "gymnasium.wrappers.RescaleAction inside."
            )
        floating = np.issubdtype(seen.dtype, np.floating)
        # Integers could not hold the action.
        self._dtype = seen.dtype if floating else np.result_type(seen.dtype, taken.dtype)
        self.observation_space = gym.spaces.Box(
            self._extended(seen.low, taken.low),
            self._extended(seen.high, taken.high),
            dtype=self._dtype.type,
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode; its first observation ends with zeros."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._extended(observation, self._start), info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Take an action; the observation ends with it, clipped."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        taken = np.clip(action, self._taken.low, self._taken.high)
        return self._extended(observation, taken), float(reward), terminated, truncated, info

    def _extended(self, observation: Array, action: Array) -> Array:
        return np.concatenate([observation, action]).astype(self._dtype)
