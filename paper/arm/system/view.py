"""Drawing the muscle arm."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gpadjust.systems.rendering import BLUE, GREEN, GREY, LIGHT, RED, SMOOTH, WHITE
from paper.arm.system.torque_arm import REAL_ARM

if TYPE_CHECKING:
    import pygame

SIZE = WIDTH, HEIGHT = 480, 400
METRE = 320.0  # pixels
At = tuple[float, float]  # across and up, in m or pixels
Color = tuple[int, int, int]
SHOULDER = (0.5, 0.62)  # of width and height

# Where the muscles are drawn: for both ends the link (0: trunk, 1: upper arm, 2: forearm), the way
# along it from its joint and the way to the side of flexion, in m. They are not the model's paths.
Place = tuple[int, float, float]
MUSCLE_LINES: tuple[tuple[Place, Place], ...] = (
    ((0, 0.02, 0.05), (2, 0.06, 0.012)),  # biceps
    ((0, 0.02, -0.05), (2, -0.025, -0.012)),  # triceps, long head
    ((0, -0.02, 0.08), (1, 0.13, 0.018)),  # deltoid, anterior
    ((0, -0.02, -0.08), (1, 0.13, -0.018)),  # deltoid, posterior
    ((1, 0.16, 0.022), (2, 0.045, 0.012)),  # brachialis
    ((1, 0.14, -0.022), (2, -0.025, -0.012)),  # triceps, lateral head
)


def draw_arm(
    canvas: pygame.Surface, state: NDArray[np.float64], activations: NDArray[np.float64]
) -> None:
    """Draw the arm, its muscles blue at rest and red when active, and its target in green.

    Args:
        canvas: ``SMOOTH`` times as large as :data:`SIZE`.
        state: Angles, velocities and target angles, in rad and s.
        activations: Of the six muscles, in [0, 1].
    """
    canvas.fill(WHITE)
    _line(canvas, (0.0, -0.12), (0.0, 0.12), GREY, 0.012)
    target = _poses(*state[4:])
    _arm(canvas, target, LIGHT)
    _circle(canvas, _place(target, (2, REAL_ARM.lengths[1], 0.0)), GREEN, 0.03, ring=True)
    links = _poses(*state[:2])
    _arm(canvas, links, GREY)
    for ends, activation in zip(MUSCLE_LINES, activations.clip(0, 1), strict=True):
        start, end = (_place(links, place) for place in ends)
        _line(canvas, start, end, _mixed(float(activation)), 0.008 + 0.012 * float(activation))
    _circle(canvas, _place(links, (2, REAL_ARM.lengths[1], 0.0)), GREEN, 0.016)


def _arm(canvas: pygame.Surface, links: list[LinkPose], color: Color) -> None:
    for link, length in zip((1, 2), REAL_ARM.lengths, strict=True):
        start, end = _place(links, (link, 0.0, 0.0)), _place(links, (link, length, 0.0))
        _line(canvas, start, end, color, 0.02)
        _circle(canvas, start, color, 0.018)


def _line(canvas: pygame.Surface, start: At, end: At, color: Color, width: float) -> None:
    import pygame

    # As a polygon: pygame's thick lines have slanted ends.
    (x, y), (x_end, y_end) = start, end
    length = math.hypot(x_end - x, y_end - y)
    across, up = (y - y_end) * width / 2 / length, (x_end - x) * width / 2 / length
    corners = [
        (x + across, y + up),
        (x_end + across, y_end + up),
        (x_end - across, y_end - up),
        (x - across, y - up),
    ]
    pygame.draw.polygon(canvas, color, [_pixel(corner) for corner in corners])


def _circle(
    canvas: pygame.Surface, center: At, color: Color, radius: float, ring: bool = False
) -> None:
    import pygame

    width = round(0.008 * SMOOTH * METRE) if ring else 0
    pygame.draw.circle(canvas, color, _pixel(center), radius * SMOOTH * METRE, width)


LinkPose = tuple[float, float, float]  # where the link's joint is, in m, and its direction


def _poses(shoulder: float, elbow: float) -> list[LinkPose]:
    length = REAL_ARM.lengths[0]
    elbow_at = (length * math.cos(shoulder), length * math.sin(shoulder))
    return [(0.0, 0.0, 0.0), (0.0, 0.0, shoulder), (*elbow_at, shoulder + elbow)]


def _place(links: list[LinkPose], place: Place) -> At:
    link, along, aside = place
    x, y, direction = links[link]
    cos, sin = math.cos(direction), math.sin(direction)
    return x + along * cos - aside * sin, y + along * sin + aside * cos


def _pixel(place: At) -> At:
    x = SHOULDER[0] * WIDTH + METRE * place[0]
    return SMOOTH * x, SMOOTH * (SHOULDER[1] * HEIGHT - METRE * place[1])


def _mixed(share: float) -> Color:
    red, green, blue = (round(b + share * (r - b)) for b, r in zip(BLUE, RED, strict=True))
    return red, green, blue
