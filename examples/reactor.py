"""A reactor of two reactions: which temperature and time make a batch worth most?

Simulated: the real activation energies differ from those that the physics has.
"""

import matplotlib.pyplot as plt
import torch
from botorch.acquisition import qLogNoisyExpectedImprovement
from botorch.optim import optimize_acqf
from botorch.utils.sampling import draw_sobol_samples

from gpadjust import CKA, fit


def worth(X, first=60e3, second=75e3):
    """Return B's yield in %, A -> B -> C, less 0.4 a minute; energies: J/mol."""
    inverse = (1 / X[:, 0] - 1 / 340) / 8.314  # X: temperature in K, time in min
    k1, k2 = 0.08 * (-first * inverse).exp(), 0.03 * (-second * inverse).exp()
    share = k1 / (k2 - k1) * ((-k1 * X[:, 1]).exp() - (-k2 * X[:, 1]).exp())
    return (100 * share - 0.4 * X[:, 1]).unsqueeze(-1)


def truth(X):
    """Return the worth by the real energies."""
    return worth(X, first=45e3, second=95e3)


def measure(X):
    """Run a batch in the plant, with noise of 0.5."""
    return truth(X) + 0.5 * torch.randn(len(X), 1, dtype=torch.float64)


torch.manual_seed(1)
bounds = torch.tensor([[310.0, 2.0], [370.0, 60.0]], dtype=torch.float64)
X = draw_sobol_samples(bounds, n=4, q=1, seed=0).squeeze(1)
Y = measure(X)
for _ in range(6):
    model = CKA(X, Y, physics=worth)
    fit(model)
    acquisition = qLogNoisyExpectedImprovement(model, X)
    new, _ = optimize_acqf(acquisition, bounds, q=1, num_restarts=4, raw_samples=64)
    X, Y = torch.cat([X, new]), torch.cat([Y, measure(new)])

T, t = (torch.linspace(*ends, 60, dtype=torch.float64) for ends in bounds.T.tolist())
grid = torch.cartesian_prod(T, t)
possible, reached = truth(grid), truth(X)[Y.argmax()].item()
misled = possible[worth(grid).argmax()].item()
print(
    f"The physics alone leads to a batch that is worth {misled:.1f}, ten measured "
    f"batches to {reached:.1f} of {possible.max():.1f}."
)

figure, axes = plt.subplots(figsize=(5, 3), layout="constrained")
figure.colorbar(axes.contourf(T, t, possible.reshape(60, 60).T, 8), label="true worth")
axes.contour(T, t, worth(grid).reshape(60, 60).T, 6, colors="w", linewidths=0.6)
axes.plot(*X.T, "C1o", markersize=4)
axes.set(xlabel="temperature, K", ylabel="time, min")
figure.savefig("reactor.png")
