"""A worn pump on a test bench, two of whose readings are plainly wrong.

Simulated: wear takes more head at high flow. The physics is the curve of the catalogue.
"""

import matplotlib.pyplot as plt
import torch

from gpadjust import CKA, fit
from gpadjust.kinds import HeavyTails


def catalogue(X):
    """Return the head in m at a flow in l/s, when the pump was new."""
    return 32 - 0.18 * X**2


generator = torch.Generator().manual_seed(0)
flow = torch.linspace(0.5, 10, 16, dtype=torch.float64).unsqueeze(-1)
noise = 0.15 * torch.randn(16, 1, generator=generator, dtype=torch.float64)
head = 0.95 * catalogue(flow) - 0.02 * flow**2 + noise
head[[4, 11]] += torch.tensor([[6.0], [-5.0]])  # air in the gauge

model = CKA(flow, head, physics=catalogue, noise=HeavyTails())
fit(model)
points = torch.linspace(0, 11, 111, dtype=torch.float64).unsqueeze(-1)
mean = model.predict(points).mean
lower, upper = model.interval(points)
at = 80  # 8 l/s
print(
    f"At 8 l/s the catalogue has {catalogue(points)[at, 0]:.1f} m, the worn pump "
    f"{mean[at, 0]:.1f} m (95 %: {lower[at, 0]:.1f} to {upper[at, 0]:.1f} m)."
)

figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
axes.fill_between(points[:, 0], lower[:, 0], upper[:, 0], alpha=0.3)
axes.plot(points, mean, label="adjusted")
axes.plot(points, catalogue(points), "C1--", label="catalogue")
axes.plot(flow, head, "k.", label="measured")
axes.set(xlabel="flow, l/s", ylabel="head, m")
axes.legend(frameon=False)
figure.savefig("pump.png")
