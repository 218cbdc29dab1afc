"""Heat transfer in a pipe, for which books have two formulas and a gap between them.

Simulated: the flow turns turbulent gradually, at Reynolds numbers of 2,300 to 10,000.
"""

import matplotlib.pyplot as plt
import torch

from gpadjust import CKA, fit


def laminar(X):
    """Return the log of Nusselt's number; X: log10 of Reynolds'."""
    return torch.full_like(X, 3.66).log()


def turbulent(X):
    """Return the same by Dittus and Boelter, of water."""
    return (0.023 * (10**X) ** 0.8 * 7**0.4).log()


generator = torch.Generator().manual_seed(0)
X = torch.linspace(2.8, 4.6, 14, dtype=torch.float64).unsqueeze(-1)
share = torch.sigmoid((X - 3.6) / 0.07)
noise = 0.05 * torch.randn(14, 1, generator=generator, dtype=torch.float64)
Y = (1 - share) * laminar(X) + share * turbulent(X) + noise

model = CKA(X, Y, physics={"laminar": laminar, "turbulent": turbulent})
fit(model)
points = torch.linspace(2.7, 4.7, 101, dtype=torch.float64).unsqueeze(-1)
mean = model.predict(points).mean
lower, upper = model.interval(points)
at = 45  # a Reynolds number of 4,000
low, middle, high = (each[at, 0].exp() for each in (lower, mean, upper))
print(f"In the gap, at Re = 4,000, Nu is {middle:.0f} (95 %: {low:.0f} to {high:.0f}).")

figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
reynolds = 10 ** points[:, 0]
axes.fill_between(reynolds, lower[:, 0].exp(), upper[:, 0].exp(), alpha=0.3)
axes.loglog(reynolds, mean.exp(), label="adjusted")
axes.loglog(reynolds, laminar(points).exp(), "C1--", label="laminar")
axes.loglog(reynolds, turbulent(points).exp(), "C2:", label="turbulent")
axes.loglog(10**X, Y.exp(), "k.", label="measured")
axes.set(xlabel="Reynolds number", ylabel="Nusselt number")
axes.legend(frameon=False)
figure.savefig("heat_exchanger.png")
