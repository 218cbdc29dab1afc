"""Drawing the cart-pole."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gpadjust.systems.rendering import BLACK, BLUE, GREEN, GREY, LIGHT, RED, SMOOTH, WHITE, View

WIDTH, HEIGHT = 600, 300
METRE = 140.0  # pixels
ROAM = 1.5  # the cart moves in the frame up to here (m); beyond, the frame moves with it
TRACK_LEVEL = 0.5  # of the height


class CartPoleView(View):
    """Frames of a cart-pole, in a window or as arrays.

    Args:
        pole_length: The length of the pole, in m.
        max_force: The force, in N, that has an arrow of 0.6 m.
        frames_per_second: The pace of the frames in the window; None for arrays without a window.

    Raises:
        gymnasium.error.DependencyNotInstalled: If ``pygame-ce`` is missing.
    """

    def __init__(
        self, pole_length: float, max_force: float, frames_per_second: int | None = None
    ) -> None:
        super().__init__("Cart-pole", (WIDTH, HEIGHT), frames_per_second)
        self.pole_length = pole_length
        self.max_force = max_force

    def draw(self, x: float, theta: float, force: float) -> NDArray[np.uint8] | None:
        """Draw a frame; return it, ``height x width x 3``, if there is no window."""
        self._draw_scene(float(x), float(theta), float(force))
        return self.show()

    def _draw_scene(self, x: float, theta: float, force: float) -> None:
        import pygame

        draw, canvas = pygame.draw, self.canvas
        scale = SMOOTH * METRE
        left = x - min(max(x, -ROAM), ROAM) - WIDTH / METRE / 2  # of the frame, in m

        def at(across: float, up: float) -> tuple[float, float]:
            return (across - left) * scale, SMOOTH * HEIGHT * TRACK_LEVEL - up * scale

        canvas.fill(WHITE)
        draw.line(canvas, GREY, at(left, 0), at(left + WIDTH / METRE, 0), round(0.012 * scale))
        for tick in range(math.ceil(2 * left), math.floor(2 * (left + WIDTH / METRE)) + 1):
            draw.line(canvas, LIGHT, at(tick / 2, -0.06), at(tick / 2, -0.14), round(0.01 * scale))

        length = self.pole_length
        goal = at(0, length)
        draw.circle(canvas, GREEN, goal, 0.08 * scale, round(0.014 * scale))
        draw.circle(canvas, GREEN, goal, 0.016 * scale)

        cart = pygame.Rect(0, 0, round(0.4 * scale), round(0.18 * scale))
        cart.center = (round(at(x, 0)[0]), round(at(x, 0)[1]))
        draw.rect(canvas, BLUE, cart, border_radius=round(0.03 * scale))

        tip = (x - length * math.sin(theta), length * math.cos(theta))
        width = 0.035
        across, up = width * math.cos(theta), width * math.sin(theta)
        rod = [
            at(x - across, -up),
            at(x + across, up),
            at(tip[0] + across, tip[1] + up),
            at(tip[0] - across, tip[1] - up),
        ]
        draw.polygon(canvas, RED, rod)
        draw.circle(canvas, RED, at(*tip), width * scale)
        draw.circle(canvas, RED, at(x, 0), width * scale)
        draw.circle(canvas, BLACK, at(x, 0), 0.018 * scale)

        reach = 0.6 * force / self.max_force
        if reach:
            side = math.copysign(1.0, reach)
            start, head, level = x + side * 0.22, min(0.08, abs(reach)), 0.0
            end = start + reach
            neck = end - side * head
            draw.line(canvas, BLACK, at(start, level), at(neck, level), round(0.025 * scale))
            draw.polygon(canvas, BLACK, [at(end, level), at(neck, 0.05), at(neck, -0.05)])
