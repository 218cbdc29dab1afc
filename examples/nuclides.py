"""Binding energies of nuclides: a liquid drop, and the shells that it lacks.

Measured (AME2020, as in OpenMC, MIT): paper/published/data/README.md of the repository.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from gpadjust import CKA, CalibratedPhysics, FunctionPhysics, Unknown, fit

DATA = Path(__file__).with_name("nuclides.csv")  # with even Z and N
Z, N, energy = np.loadtxt(DATA, delimiter=",", skiprows=1)[:, :3].T
X = torch.tensor(np.stack([Z, N], axis=1))
Y = torch.tensor(energy * (Z + N) / 1000).unsqueeze(-1)  # MeV


def drop(X, p):
    """Return binding energies in MeV by Bethe and Weizsaecker, even Z and N."""
    Z, N = X.unbind(-1)
    A = Z + N
    bulk = p.volume * A - p.surface * A ** (2 / 3)
    charge = p.coulomb * Z * (Z - 1) / A ** (1 / 3)
    return bulk - charge - p.asymmetry * (N - Z) ** 2 / A


unknowns = {
    "volume": Unknown(15.8, sd=0.5, unit="MeV"),
    "surface": Unknown(18.3, sd=1.0, unit="MeV"),
    "coulomb": Unknown(0.714, sd=0.05, unit="MeV"),
    "asymmetry": Unknown(23.2, sd=2.0, unit="MeV"),
}
liquid = FunctionPhysics(drop, unknowns=unknowns)
order = torch.randperm(len(X), generator=torch.Generator().manual_seed(0))
train, test = order[:150], order[150:]
errors = []
for kind in (CalibratedPhysics, CKA):  # the drop alone, and adjusted
    model = kind(X[train], Y[train], physics=liquid)
    fit(model, "map")
    errors.append(model.predict(X[test]).mean - Y[test])
drop_alone, adjusted = (error.square().mean().sqrt() for error in errors)
print(
    f"Error on {len(test)} nuclides that were left out: liquid drop, fitted to 150, "
    f"{drop_alone:.2f} MeV, adjusted {adjusted:.2f} MeV."
)

figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
axes.plot(X[test, 1], errors[0], "C1x", markersize=4, label="liquid drop")
axes.plot(X[test, 1], errors[1], "C0.", label="adjusted")
for magic in (28, 50, 82, 126):
    axes.axvline(magic, color="0.8", linewidth=1, zorder=0)
axes.set(xlabel="neutrons (lines: closed shells)", ylabel="error, MeV")
axes.legend(frameon=False)
figure.savefig("nuclides.png")
