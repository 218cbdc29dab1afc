"""Fits on Forrester's pair: accuracy, and invariance to units."""

import math
import statistics
from functools import partial

import pytest
import torch
from torch.quasirandom import SobolEngine

from gpadjust import AR1, CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP, fit

BOUNDS = torch.tensor([[-0.6], [1.0]], dtype=torch.float64)
BUILD = {
    "ZeroMeanGP": lambda X, Y, physics: ZeroMeanGP(X, Y),
    "PhysicsMeanGP": PhysicsMeanGP,
    "ScaleGP": ScaleGP,
    "CKA": CKA,
    "AR1": lambda X, Y, physics: AR1(X, Y, physics=physics, bounds=BOUNDS, num_low=16),
    "RRA": lambda X, Y, physics: RRA(X, Y, physics=physics, num_features=32),
}
EXACT = 2e-5  # differences of RMSE below this are rounding: the pair's spread is 4

pytestmark = pytest.mark.filterwarnings("ignore:f_p is nearly zero:UserWarning")


@pytest.fixture
def error(forrester):
    """The RMSE of a model's mean in the units of the pair, for changed units of x and y."""

    def error(build, seed, scale=1.0, offset=0.0, stretch=1.0, shift=0.0):
        X, Y = forrester.data(seed)

        def physics(X):
            return scale * forrester.crude((X - shift) / stretch) + offset

        model = build(shift + stretch * X, scale * Y + offset, physics=physics)
        fit(model, "map")
        Z = forrester.test_X
        with torch.no_grad():
            mean = (model.posterior(shift + stretch * Z).mean - offset) / scale
        return (mean - forrester.truth(Z)).square().mean().sqrt().item()

    return error


CASES = [*((kind, 0) for kind in BUILD), ("CKA", 1)]
QUICK = [("CKA", 0), ("PhysicsMeanGP", 0)]


@pytest.mark.parametrize(
    ("kind", "seed"),
    [pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow) for case in CASES],
)
def test_the_scale_of_targets_and_physics(error, kind, seed):
    expected = error(BUILD[kind], seed)
    for scale in (1e-4, 1e4):
        actual = error(BUILD[kind], seed, scale=scale)
        assert actual == pytest.approx(expected, rel=0.05, abs=EXACT)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_common_offset_with_center(error, seed):
    build = partial(CKA, center="mean")
    expected = error(build, seed)
    actual = error(build, seed, offset=-1000.0)
    assert actual == pytest.approx(expected, rel=0.05, abs=EXACT)


@pytest.mark.parametrize(
    ("stretch", "shift"), [(1000.0, -70.0), pytest.param(0.01, 5.0, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    "kind",
    [
        "CKA",
        *(pytest.param(k, marks=pytest.mark.slow) for k in ("ZeroMeanGP", "PhysicsMeanGP", "RRA")),
    ],
)
def test_units_of_the_inputs(error, kind, stretch, shift):
    if kind == "RRA" and shift:
        shift = 0.0  # the phases of its features are not invariant to shifts
    expected = error(BUILD[kind], 0)
    actual = error(BUILD[kind], 0, stretch=stretch, shift=shift)
    assert actual == pytest.approx(expected, rel=0.05, abs=EXACT)


@pytest.mark.slow
def test_cka_is_exact_on_a_pair_within_its_class(error):
    errors = [error(BUILD["CKA"], seed) for seed in range(3)]
    assert statistics.median(errors) <= 0.002
    assert errors[0] < 0.3 * error(BUILD["PhysicsMeanGP"], 0)


# One answer, whatever the seed of a fit


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
