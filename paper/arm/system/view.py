"""Drawing the muscle arm; places are complex numbers, across and up, in m."""

from __future__ import annotations

from cmath import rect
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpadjust.systems.rendering import BLUE, GREEN, GREY, LIGHT, RED, SMOOTH, WHITE
from paper.arm.system.torque_arm import REAL_ARM

if TYPE_CHECKING:
    import pygame

SIZE = WIDTH, HEIGHT = 480, 400
METRE = 320.0  # pixels
SHOULDER = (0.5, 0.62)  # of width and height
Color = tuple[int, int, int]

# Where the muscles are drawn: for both ends the link (0: trunk, 1: upper arm, 2: forearm), and the
# place along it from its joint and to the side of flexion, in m. They are not the model's paths.
MUSCLE_LINES = (
    ((0, 0.02 + 0.05j), (2, 0.06 + 0.012j)),  # biceps
    ((0, 0.02 - 0.05j), (2, -0.025 - 0.012j)),  # triceps, long head
    ((0, -0.02 + 0.08j), (1, 0.13 + 0.018j)),  # deltoid, anterior
    ((0, -0.02 - 0.08j), (1, 0.13 - 0.018j)),  # deltoid, posterior
    ((1, 0.16 + 0.022j), (2, 0.045 + 0.012j)),  # brachialis
    ((1, 0.14 - 0.022j), (2, -0.025 - 0.012j)),  # triceps, lateral head
)


class Link(NamedTuple):
    """Where the joint of a link is, and its direction."""

    joint: complex
    direction: complex

    def place(self, along: complex) -> complex:
        """Return a place along the link, and to its side."""
        return self.joint + along * self.direction


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
    _line(canvas, -0.12j, 0.12j, GREY, 0.012)
    _circle(canvas, _arm(canvas, state[4:], LIGHT)[3].joint, GREEN, 0.03, ring=True)
    links = _arm(canvas, state[:2], GREY)
    for ends, activation in zip(MUSCLE_LINES, activations.clip(0, 1), strict=True):
        start, end = (links[link].place(along) for link, along in ends)
        red, green, blue = (
            round(b + float(activation) * (r - b)) for b, r in zip(BLUE, RED, strict=True)
        )
        _line(canvas, start, end, (red, green, blue), 0.008 + 0.012 * float(activation))
    _circle(canvas, links[3].joint, GREEN, 0.016)


def _arm(canvas: pygame.Surface, angles: NDArray[np.float64], color: Color) -> list[Link]:
    """Draw the links; return the trunk, these and the hand."""
    shoulder, elbow = angles.tolist()
    links = [Link(0j, 1), Link(0j, rect(1, shoulder))]
    for length, angle in zip(REAL_ARM.lengths, (shoulder + elbow, 0.0), strict=True):
        start, end = links[-1].joint, links[-1].place(length)
        _line(canvas, start, end, color, 0.02)
        _circle(canvas, start, color, 0.018)
        links.append(Link(end, rect(1, angle)))
    return links


def _line(canvas: pygame.Surface, start: complex, end: complex, color: Color, width: float) -> None:
    import pygame

    # As a polygon: pygame's thick lines have slanted ends.
    side = 1j * (end - start) / abs(end - start) * width / 2
    corners = (start + side, end + side, end - side, start - side)
    pygame.draw.polygon(canvas, color, [_pixel(corner) for corner in corners])


def _circle(
    canvas: pygame.Surface, center: complex, color: Color, radius: float, ring: bool = False
) -> None:
    import pygame

    width = round(0.008 * SMOOTH * METRE) if ring else 0
    pygame.draw.circle(canvas, color, _pixel(center), radius * SMOOTH * METRE, width)


def _pixel(place: complex) -> tuple[float, float]:
    x, y = SHOULDER[0] * WIDTH + METRE * place.real, SHOULDER[1] * HEIGHT - METRE * place.imag
    return SMOOTH * x, SMOOTH * y
