"""What the environments with a picture share."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from gpadjust.envs.view import View

RENDER_MODES = ["human", "rgb_array"]

Array = NDArray[np.float32]
V = TypeVar("V", bound=View)


class ViewedEnv(gym.Env[Array, Array], Generic[V]):
    """The base of environments whose ``state`` a :class:`View` draws.

    A subclass says in :meth:`_open_view` and :meth:`_draw` how, has ``metadata`` with
    ``RENDER_MODES`` and ``"render_fps"``, and calls :meth:`_show` at the end of ``reset`` and
    ``step``.

    Args:
        render_mode: ``"human"`` shows a window, ``"rgb_array"`` lets ``render`` return a frame.

    Raises:
        ValueError: If it is another one.
    """

    def __init__(self, render_mode: str | None) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(
                f"render_mode must be None, 'human' or 'rgb_array'; found {render_mode!r}."
            )
        self.render_mode = render_mode
        self.state: NDArray[np.float64] | None = None
        self._view: V | None = None

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the system.

        Returns:
            The frame ``height x width x 3`` in mode ``"rgb_array"``, else None.

        Raises:
            gymnasium.error.DependencyNotInstalled: If ``pygame-ce`` is missing.
            gymnasium.error.ResetNeeded: If no episode was started.
        """
        if self.render_mode is None:
            gym.logger.warn(
                "There is nothing to render without a render mode; build the environment with "
                "render_mode='human' or 'rgb_array'."
            )
            return None
        if self.state is None:
            raise gym.error.ResetNeeded("Call reset before render.")
        if self._view is None:
            pace = self.metadata["render_fps"] if self.render_mode == "human" else None
            self._view = self._open_view(pace)
        return self._draw(self._view, self.state)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None

    def __getstate__(self) -> dict[str, Any]:
        # A window cannot be pickled; the copy opens its own when it is rendered.
        return {**self.__dict__, "_view": None}

    def _open_view(self, frames_per_second: int | None) -> V:
        """The view; of a window, the pace of its frames is given."""
        raise NotImplementedError

    def _draw(self, view: V, state: NDArray[np.float64]) -> NDArray[np.uint8] | None:
        """Draw a state with the view."""
        raise NotImplementedError

    def _show(self) -> None:
        """Draw in the window, if there is one."""
        if self.render_mode == "human":
            self.render()
