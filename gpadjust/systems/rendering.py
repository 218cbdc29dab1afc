"""The base of environments with frames, and their colours."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pygame

SMOOTH = 2  # scale of the drawing before it is scaled down, for smooth edges

RENDER_MODES = ["rgb_array"]

Array = NDArray[np.float32]
WHITE, BLACK, GREY, LIGHT = (255, 255, 255), (0, 0, 0), (110, 110, 110), (215, 215, 215)
BLUE, RED, GREEN = (31, 79, 130), (204, 77, 77), (44, 140, 68)


class ViewedEnv(gym.Env[Array, Array]):
    """The base of environments with frames of their ``state``.

    A subclass defines ``size`` (width and height in pixels), :meth:`_draw`, and ``metadata`` with
    ``RENDER_MODES`` and ``"render_fps"``.

    Args:
        render_mode: With ``"rgb_array"`` ``render`` returns a frame, which
            ``gymnasium.wrappers.HumanRendering`` shows in a window.

    Raises:
        ValueError: If the mode is neither this nor None.
    """

    size: tuple[int, int]

    def __init__(self, render_mode: str | None) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(
                f"render_mode must be None or 'rgb_array'; found {render_mode!r}. For a window, "
                "put gymnasium.wrappers.HumanRendering around the environment."
            )
        self.render_mode = render_mode
        self.state: NDArray[np.float64] | None = None

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the system; return the frame ``height x width x 3``, or None without a render mode.

        Raises:
            gymnasium.error.DependencyNotInstalled: If ``pygame-ce`` is missing.
            gymnasium.error.ResetNeeded: Before the first episode.
        """
        if self.render_mode is None:
            gym.logger.warn("There is no frame without render_mode='rgb_array'.")
            return None
        if self.state is None:
            raise gym.error.ResetNeeded("Call reset before render.")
        try:
            import pygame  # not at the top: environments run without it
        except ImportError as error:
            raise DependencyNotInstalled(
                "Rendering needs pygame-ce; run `pip install pygame-ce`."
            ) from error
        canvas = pygame.Surface((SMOOTH * self.size[0], SMOOTH * self.size[1]))
        self._draw(canvas, self.state)
        frame = pygame.transform.smoothscale(canvas, self.size)
        # pygame has columns first, images have rows first.
        return np.ascontiguousarray(pygame.surfarray.array3d(frame).swapaxes(0, 1))

    def _draw(self, canvas: pygame.Surface, state: NDArray[np.float64]) -> None:
        """Draw a state."""
        raise NotImplementedError
