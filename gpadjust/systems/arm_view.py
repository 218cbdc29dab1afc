"""Drawing the muscle arm."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gpadjust.systems.rendering import BLUE, GREEN, GREY, LIGHT, RED, SMOOTH, WHITE, Colour, View
from gpadjust.systems.torque_arm import REAL_ARM

WIDTH, HEIGHT = 480, 400
METRE = 320.0  # pixels
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


class ArmView(View):
    """Frames of the arm, its muscles blue at rest and red when active, and its target in green.

    Args:
        frames_per_second: The pace of the frames in a window; None for arrays without a window.

    Raises:
        gymnasium.error.DependencyNotInstalled: If ``pygame-ce`` is missing.
    """

    def __init__(self, frames_per_second: int | None = None) -> None:
        super().__init__("Muscle arm", (WIDTH, HEIGHT), frames_per_second)

    def draw(
        self, state: NDArray[np.float64], activations: NDArray[np.float64]
    ) -> NDArray[np.uint8] | None:
        """Draw a frame; return it, ``height x width x 3``, if there is no window.

        Args:
            state: Angles, velocities and target angles, in rad and s.
            activations: Of the six muscles, in [0, 1].
        """
        self.canvas.fill(WHITE)
        self._line((0.0, -0.12), (0.0, 0.12), GREY, 0.012)
        target = _poses(*state[4:])
        self._arm(target, LIGHT)
        self._circle(_place(target, (2, REAL_ARM.lengths[1], 0.0)), GREEN, 0.03, ring=True)
        links = _poses(*state[:2])
        self._arm(links, GREY)
        for ends, activation in zip(MUSCLE_LINES, activations.clip(0, 1), strict=True):
            start, end = (_place(links, place) for place in ends)
            self._line(start, end, _mixed(float(activation)), 0.008 + 0.012 * float(activation))
        self._circle(_place(links, (2, REAL_ARM.lengths[1], 0.0)), GREEN, 0.016)
        return self.show()

    def _arm(self, links: list[LinkPose], colour: Colour) -> None:
        for link, length in zip((1, 2), REAL_ARM.lengths, strict=True):
            start, end = _place(links, (link, 0.0, 0.0)), _place(links, (link, length, 0.0))
            self._line(start, end, colour, 0.02)
            self._circle(start, colour, 0.018)

    def _line(
        self, start: tuple[float, float], end: tuple[float, float], colour: Colour, width: float
    ) -> None:
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
        pygame.draw.polygon(self.canvas, colour, [_pixel(corner) for corner in corners])

    def _circle(
        self, center: tuple[float, float], colour: Colour, radius: float, ring: bool = False
    ) -> None:
        import pygame

        width = round(0.008 * SMOOTH * METRE) if ring else 0
        pygame.draw.circle(self.canvas, colour, _pixel(center), radius * SMOOTH * METRE, width)


LinkPose = tuple[float, float, float]  # where the link's joint is, in m, and its direction


def _poses(shoulder: float, elbow: float) -> list[LinkPose]:
    length = REAL_ARM.lengths[0]
    elbow_at = (length * math.cos(shoulder), length * math.sin(shoulder))
    return [(0.0, 0.0, 0.0), (0.0, 0.0, shoulder), (*elbow_at, shoulder + elbow)]


def _place(links: list[LinkPose], place: Place) -> tuple[float, float]:
    link, along, aside = place
    x, y, direction = links[link]
    cos, sin = math.cos(direction), math.sin(direction)
    return x + along * cos - aside * sin, y + along * sin + aside * cos


def _pixel(place: tuple[float, float]) -> tuple[float, float]:
    x = SHOULDER[0] * WIDTH + METRE * place[0]
    return SMOOTH * x, SMOOTH * (SHOULDER[1] * HEIGHT - METRE * place[1])


def _mixed(share: float) -> Colour:
    red, green, blue = (round(b + share * (r - b)) for b, r in zip(BLUE, RED, strict=True))
    return red, green, blue
