"""The base of environments with frames, and the frames of the cart-pole."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pygame

SMOOTH = 2  # scale of the drawing before it is scaled down, for smooth edges

SIZE = WIDTH, HEIGHT = 600, 300
METRE = 140.0  # pixels
ROAM = 1.5  # m, from which on the frame moves with the cart

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

        An error of Gymnasium is raised if ``pygame-ce`` is missing, or before the first episode.
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


def draw_cart_pole(
    canvas: pygame.Surface, x: float, theta: float, length: float, reach: float
) -> None:
    """Draw a cart at x, a pole at an angle from upright, and an arrow of the force, in m and rad.

    The canvas is ``SMOOTH`` times as large as :data:`SIZE`.
    """
    import pygame

    draw = pygame.draw
    scale = SMOOTH * METRE
    left = x - min(max(x, -ROAM), ROAM) - WIDTH / METRE / 2  # of the frame, in m

    def pixel(across: float, up: float) -> tuple[float, float]:
        return (across - left) * scale, SMOOTH * HEIGHT / 2 - up * scale

    # The track with a mark at each half metre, and the goal of the tip.
    canvas.fill(WHITE)
    right = left + WIDTH / METRE
    draw.line(canvas, GREY, pixel(left, 0), pixel(right, 0), round(0.012 * scale))
    for tick in range(math.ceil(2 * left), math.floor(2 * right) + 1):
        ends = pixel(tick / 2, -0.06), pixel(tick / 2, -0.14)
        draw.line(canvas, LIGHT, *ends, round(0.01 * scale))
    draw.circle(canvas, GREEN, pixel(0, length), 0.08 * scale, round(0.014 * scale))
    draw.circle(canvas, GREEN, pixel(0, length), 0.016 * scale)

    cart = pygame.Rect(0, 0, round(0.4 * scale), round(0.18 * scale))
    cart.center = (round(pixel(x, 0)[0]), round(pixel(x, 0)[1]))
    draw.rect(canvas, BLUE, cart, border_radius=round(0.03 * scale))

    # The pole, counter-clockwise from upright, with round ends and the hinge.
    tip = (x - length * math.sin(theta), length * math.cos(theta))
    width = 0.035
    across, up = width * math.cos(theta), width * math.sin(theta)
    rod = [
        pixel(x - across, -up),
        pixel(x + across, up),
        pixel(tip[0] + across, tip[1] + up),
        pixel(tip[0] - across, tip[1] - up),
    ]
    draw.polygon(canvas, RED, rod)
    draw.circle(canvas, RED, pixel(*tip), width * scale)
    draw.circle(canvas, RED, pixel(x, 0), width * scale)
    draw.circle(canvas, BLACK, pixel(x, 0), 0.018 * scale)

    if reach:  # the arrow of the force begins beside the cart
        side = math.copysign(1.0, reach)
        start = x + side * 0.22
        end = start + reach
        neck = end - side * min(0.08, abs(reach))
        draw.line(canvas, BLACK, pixel(start, 0), pixel(neck, 0), round(0.025 * scale))
        draw.polygon(canvas, BLACK, [pixel(end, 0), pixel(neck, 0.05), pixel(neck, -0.05)])
