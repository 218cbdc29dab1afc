"""A cantilever by the textbook: how far its end moves under a force."""

import numpy as np


def deflection(X: np.ndarray) -> np.ndarray:
    """Deflection in mm of rows of force in N, length in m and thickness in mm."""
    force, length, thickness = X[:, 0], X[:, 1], X[:, 2] / 1000
    stiffness = 210e9 * 0.03 * thickness**3 / 12  # of a steel strip 30 mm wide, in N m²
    return 1000 * force * length**3 / (3 * stiffness)
