"""One answer, whatever the seed of a fit."""

import math

import pytest
import torch
from torch.quasirandom import SobolEngine

from gpadjust import CKA, fit

SEEDS = range(6)


def system(d):
    """A function of ``d`` inputs of different weight, and its physics."""
    weights = torch.logspace(0.5, -0.5, d, dtype=torch.float64)

    def physics(X):
        return (2 * X @ weights).sin().unsqueeze(-1)

    def truth(X):
        along = (X @ weights.flip(0)).unsqueeze(-1)
        return (1.3 + 0.3 * along.sin()) * physics(X) + 0.4 * (2 * along).cos()

    return truth, physics


def answers(d, per_input, noise):
    """Means, standard deviations and widths of intervals, ``seeds x points``."""
    truth, physics = system(d)
    generator = torch.Generator().manual_seed(d)
    X = SobolEngine(d, scramble=True, seed=d).draw(per_input * d, dtype=torch.float64)
    Z = torch.rand(200, d, generator=generator, dtype=torch.float64)
    Y = truth(X) + noise * torch.randn(len(X), 1, generator=generator, dtype=torch.float64)
    found = []
    for seed in SEEDS:
        model = CKA(X, Y, physics=physics)
        fit(model, seed=seed)
        mean, variance = model.predict(Z)
        low, high = model.interval(Z)
        found.append((mean, variance.sqrt(), high - low))
    return [torch.stack(each).squeeze(-1) for each in zip(*found, strict=True)]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")
def test_the_seed_of_a_fit_moves_its_answer_little():
    shifts, ratios = [], []
    for d, per_input, noise in ((1, 5, 0.05), (2, 10, 0.05), (3, 5, 0.0), (4, 10, 0.1)):
        mean, sd, width = answers(d, per_input, noise)
        shift = (mean - mean.mean(0)).square().mean() / sd.square().mean()
        shifts.append(shift.sqrt().item())
        of_seeds = width.log().mean(-1).exp()
        ratios.append((of_seeds.max() / of_seeds.min()).item())
    assert math.fsum(shifts) / len(shifts) < 0.2
    assert max(shifts) < 0.4
    assert math.prod(ratios) ** (1 / len(ratios)) < 1.25
