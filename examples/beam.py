"""A cantilever by the textbook: how far its end moves under a force."""

from pathlib import Path

import numpy as np


def deflection(X: np.ndarray) -> np.ndarray:
    """Return deflections in mm by force in N, length in m, thickness in mm."""
    force, length, thickness = X[:, 0], X[:, 1], X[:, 2] / 1000
    stiffness = 210e9 * 0.03 * thickness**3 / 12  # of steel, 30 mm wide, in N m²
    return 1000 * force * length**3 / (3 * stiffness)


if __name__ == "__main__":  # `python -m gpadjust report` needs the formula alone
    import matplotlib.pyplot as plt

    from gpadjust import CKA, BlackBoxPhysics, fit
    from gpadjust.validation import leave_one_out

    table = np.loadtxt(Path(__file__).with_name("beam.csv"), delimiter=",", skiprows=1)
    X, measured = table[:, :3], table[:, 3:]  # simulated, with a clamp that yields
    model = CKA(X, measured, physics=BlackBoxPhysics(deflection))
    fit(model)
    left_out = leave_one_out(model)
    alone = np.sqrt(np.mean((deflection(X) - measured[:, 0]) ** 2))
    adjusted = left_out.score().rmse.item()
    print(f"Error of the formula {alone:.2f} mm, adjusted {adjusted:.2f} mm.")

    figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
    axes.axline((1, 1), slope=1, color="0.7")
    axes.loglog(measured, deflection(X), "C1x", label="formula")
    axes.loglog(measured, left_out.mean, "C0.", label="adjusted, left out")
    axes.set(xlabel="measured deflection, mm", ylabel="predicted, mm")
    axes.legend(frameon=False)
    figure.savefig("beam.png")
