"""A battery that fades: when will it have 80 % of its capacity?

Simulated: beside the law of the square root, plating takes a share that grows.
"""

import matplotlib.pyplot as plt
import torch

from gpadjust import CKA, FunctionPhysics, Unknown, fit

law = FunctionPhysics(
    lambda X, p: 100 - p.fade * X[:, 0].sqrt(),  # in %, after X thousand cycles
    unknowns={"fade": Unknown(10.0, factor=2.0, unit="%")},
)
generator = torch.Generator().manual_seed(0)
cycles = torch.linspace(0.02, 1.2, 15, dtype=torch.float64).unsqueeze(-1)
noise = 0.2 * torch.randn(15, 1, generator=generator, dtype=torch.float64)
capacity = 100 - 9 * cycles.sqrt() - 3 * cycles**2 + noise

model = CKA(cycles, capacity, physics=law)
fit(model)
points = torch.linspace(0.02, 2.4, 120, dtype=torch.float64).unsqueeze(-1)
mean = model.predict(points).mean
lower, upper = model.interval(points, level=0.9)
truth = 100 - 9 * points.sqrt() - 3 * points**2
careful, expected, true = (
    1000 * points[(each < 80).nonzero()[0, 0], 0] for each in (lower, mean, truth)
)
print(
    f"80 % is expected after {expected:.0f} cycles, with a probability of 95 % "
    f"not before {careful:.0f}; it will be after {true:.0f}."
)

figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
thousand = 1000 * points[:, 0]
axes.fill_between(thousand, lower[:, 0], upper[:, 0], alpha=0.3)
axes.plot(thousand, mean, label="adjusted")
axes.plot(thousand, truth, "k:", label="truth")
axes.plot(1000 * cycles, capacity, "k.", label="measured")
axes.axhline(80, color="0.7", linewidth=1)
axes.set(xlabel="cycles", ylabel="capacity, %")
axes.legend(frameon=False)
figure.savefig("battery.png")
