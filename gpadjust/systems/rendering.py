"""Pictures of systems: a frame to draw on, and environments that have one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pygame

SMOOTH = 2  # drawn so many times larger, then scaled down, for smooth edges

RENDER_MODES = ["human", "rgb_array"]

Array = NDArray[np.float32]
WHITE, BLACK, GREY, LIGHT = (255, 255, 255), (0, 0, 0), (110, 110, 110), (215, 215, 215)
BLUE, RED, GREEN = (31, 79, 130), (204, 77, 77), (44, 140, 68)


class View:
    """Frames of a system: what is drawn on ``canvas``, in a window or as arrays.

    Args:
        caption: The title of the window.
        size: Width and height of the frames, in pixels; the canvas has ``SMOOTH`` times as many.
        frames_per_second: The pace of the frames in the window; None for arrays without a window.

    Raises:
        gymnasium.error.DependencyNotInstalled: If ``pygame-ce`` is missing.
    """

    def __init__(self, caption: str, size: tuple[int, int], frames_per_second: int | None) -> None:
        try:
            import pygame
        except ImportError as error:
            raise DependencyNotInstalled(
                "Rendering needs pygame-ce; run `pip install pygame-ce`."
            ) from error
        self.size = size
        self.frames_per_second = frames_per_second
        self.canvas = pygame.Surface((SMOOTH * size[0], SMOOTH * size[1]))
        self._window: pygame.Surface | None = None
        if frames_per_second is not None:
            pygame.display.init()
            pygame.display.set_caption(caption)
            self._window = pygame.display.set_mode(size)
        self._clock = pygame.time.Clock()

    def show(self) -> NDArray[np.uint8] | None:
        """Show what is drawn; return it, ``height x width x 3``, if there is no window."""
        import pygame

        frame = pygame.transform.smoothscale(self.canvas, self.size)
        if self._window is None:
            return np.ascontiguousarray(pygame.surfarray.array3d(frame).swapaxes(0, 1))
        self._window.blit(frame, (0, 0))
        pygame.event.pump()
        self._clock.tick(self.frames_per_second or 0)
        pygame.display.flip()
        return None

    def close(self) -> None:
        """Close the window."""
        import pygame

        if self._window is not None:
            pygame.display.quit()
            self._window = None


class ViewedEnv(gym.Env[Array, Array]):
    """The base of environments whose ``state`` can be seen.

    A subclass says in ``caption``, ``size`` and :meth:`_draw` how, has ``metadata`` with
    ``RENDER_MODES`` and ``"render_fps"``, and calls :meth:`_show` at the end of ``reset`` and
    ``step``.

    Args:
        render_mode: ``"human"`` shows a window, ``"rgb_array"`` lets ``render`` return a frame.

    Raises:
        ValueError: If it is another one.
    """

    caption: str
    size: tuple[int, int]

    def __init__(self, render_mode: str | None) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(
                f"render_mode must be None, 'human' or 'rgb_array'; found {render_mode!r}."
            )
        self.render_mode = render_mode
        self.state: NDArray[np.float64] | None = None
        self._view: View | None = None

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
            self._view = View(self.caption, self.size, pace)
        self._draw(self._view.canvas, self.state)
        return self._view.show()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
            self._view = None

    def __getstate__(self) -> dict[str, Any]:
        # A window cannot be pickled; the copy opens its own when it is rendered.
        return {**self.__dict__, "_view": None}

    def _draw(self, canvas: pygame.Surface, state: NDArray[np.float64]) -> None:
        """Draw a state."""
        raise NotImplementedError

    def _show(self) -> None:
        """Draw in the window, if there is one."""
        if self.render_mode == "human":
            self.render()
