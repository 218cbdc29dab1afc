"""Frames of the cart-pole."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from gpadjust.systems.rendering import BLACK, BLUE, GREEN, GREY, LIGHT, RED, SMOOTH, WHITE

if TYPE_CHECKING:
    import pygame

SIZE = WIDTH, HEIGHT = 600, 300
METRE = 140.0  # pixels
ROAM = 1.5  # m, from which on the frame moves with the cart


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
