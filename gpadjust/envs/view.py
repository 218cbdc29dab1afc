"""A frame to draw on, shown in a window or returned as an array."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pygame

SMOOTH = 2  # drawn so many times larger, then scaled down, for smooth edges

Colour = tuple[int, int, int]
WHITE, BLACK, GREY, LIGHT = (255, 255, 255), (0, 0, 0), (110, 110, 110), (215, 215, 215)
BLUE, RED, GREEN = (31, 79, 130), (204, 77, 77), (44, 140, 68)


class View:
    """Frames of a system. A subclass draws on ``canvas``, then calls :meth:`show`.

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
