"""A guard around an environment, for real steps that cannot be data."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from gpadjust.control.episodes import check_observation, fault

_IN_VAIN = 3  # successive episodes without a step, after which another makes no sense


class FailedStepWarning(UserWarning):
    """A real step could not be made, or returned what cannot be data; it is not stored."""


class StepGuard(gym.Wrapper[Any, Any, Any, Any]):
    """Ends an episode at a step that fails, as if the step had not happened.

    A step fails that raises an error, or whose observation or reward is not finite or larger than
    1e25. The episode is truncated at the last good observation, with a
    :class:`FailedStepWarning`, a reward of zero and a true ``info["step_failed"]``, which an
    environment may also set itself: no learner of the library takes the step as data. Agents put a
    guard around their environment, and Dyna around each of a ``DummyVecEnv``; around environments
    of other processes put one yourself, as in
    ``SubprocVecEnv([lambda: StepGuard(make()), ...])``. Interruptions and errors of ``reset`` pass.

    Raises:
        RuntimeError: By ``step``, if the first step of three successive episodes fails.
        ValueError: By ``reset``, if the first observation of an episode cannot be data.

    Example:
        >>> from gpadjust.systems import cart_pole
        >>> env = StepGuard(cart_pole().make())
        >>> _ = env.reset(seed=0)
        >>> "step_failed" in env.step(env.action_space.sample())[4]
        False
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self._last: NDArray[Any] = np.empty(0)  # the last good observation
        self._steps = 0  # good ones of the episode
        self._in_vain = 0

    @staticmethod
    def around(env: gym.Env[Any, Any]) -> StepGuard:
        """Return the environment with one guard around it."""
        return env if isinstance(env, StepGuard) else StepGuard(env)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(**options)
        check_observation(observation, "An episode cannot begin")
        self._last, self._steps = np.array(observation), 0
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Make a step, or end the episode where it fails."""
        cause = None
        try:
            result = self.env.step(action)
            problem = fault(result[0], result[1])
        except Exception as error:  # any error of a machine, or its driver
            cause = error
            problem = f"the environment raised {type(error).__name__}: {error}"
        if not problem:
            self._last = np.array(result[0])  # a copy: the environment may write over it
            self._steps += 1
            self._in_vain = 0
            return result
        message = f"Step {self._steps + 1} of an episode failed, and ends it: {problem}."
        if not self._steps:
            self._in_vain += 1
        if self._in_vain >= _IN_VAIN:
            self._in_vain = 0
            raise RuntimeError(
                f"{message} The {_IN_VAIN - 1} previous episodes had no valid step either. Fix the "
                "environment and call `learn` again; all earlier steps are stored."
            ) from cause
        warnings.warn(
            f"{message} Earlier steps are stored, and learning continues with the next episode. If "
            "it happens often, check the sensor or the simulator.",
            FailedStepWarning,
            stacklevel=2,
        )
        return self._last.copy(), 0.0, False, True, {"step_failed": True}
