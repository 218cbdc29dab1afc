"""Parameters, ridges and folds: cases, references, tables, and a run of two cases."""

import math

import pytest
import torch

from paper.common.runner import main
from paper.parameters import FOLDS, NINE, RIDGES, Parameters, Ridges, Settings
from paper.parameters.laws import PROBLEMS, Case, case
from paper.parameters.reference import Posterior, distance, ends, grid, sample
from paper.parameters.ridges import tables


def line(seed):
    """A case that is linear in two parameters, of which the posterior is known."""
    from gpadjust.physics import FunctionPhysics, Unknown

    generator = torch.Generator().manual_seed(seed)
    X = torch.linspace(0, 1, 12, dtype=torch.float64).unsqueeze(-1)
    unknowns = {"a": Unknown(0.0, sd=1.0), "b": Unknown(0.0, sd=1.0)}
    law = FunctionPhysics(lambda X, p: p.a + p.b * X[:, 0], unknowns=unknowns)
    true = torch.tensor([0.4, -0.7], dtype=torch.float64)
    noise = torch.randn(12, 1, generator=generator, dtype=torch.float64)
    system = law(X, true)
    return Case(X, system, system + 0.1 * noise, law, {"a": 0.4, "b": -0.7}, 0.1)


def test_references_agree_on_a_line():
    """The grid, importance sampling, and the normal distribution at the noise that is likely."""
    known = line(1)
    by_grid = grid(known, (301, 301))
    by_sample = sample(Posterior(known, "physics"), 0)
    middle = (by_grid[1].unsqueeze(-1) * by_grid[0]).sum(0)
    J = torch.cat([torch.ones(12, 1).double(), known.X], dim=-1)
    covariance = torch.linalg.inv(J.mT @ J / 0.1**2 + torch.eye(2))
    assert torch.allclose(middle, covariance @ J.mT @ known.Y.squeeze(-1) / 0.1**2, atol=0.03)
    for one, two in zip(ends(*by_grid), ends(*by_sample), strict=True):
        assert torch.allclose(one, two, atol=0.05)
    low, high = ends(*by_grid)
    widths = 2 * 1.96 * covariance.diagonal().sqrt()
    assert ((high - low) / widths).log().abs().max() < math.log(1.6)


def test_distance_of_distributions():
    values = torch.linspace(0, 1, 1001, dtype=torch.float64).unsqueeze(-1)
    weights = torch.full((1001,), 1 / 1001, dtype=torch.float64)
    draws = torch.rand(4000, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert distance(draws, values, weights) < 0.04
    assert distance(0.5 * draws, values, weights) == pytest.approx(0.5, abs=0.04)


@pytest.mark.parametrize("name", PROBLEMS)
def test_cases_are_of_their_law(name):
    known = case(name, 7)
    assert known.X.shape[0] == PROBLEMS[name].number
    true = torch.tensor([*known.true.values()], dtype=torch.float64)
    torch.testing.assert_close(known.system, known.physics(known.X, true))
    misfit = (known.Y - known.system).square().mean().sqrt()
    assert 0.4 < misfit / known.noise < 1.8
    assert name == NINE or name in RIDGES + FOLDS


def test_targets(tmp_path):
    def record(problem, model, seed, low, warned, far):
        return {
            "problem": problem,
            "model": model,
            "seed": seed,
            "true": [0.0, 0.0],
            "interval": [[low, -1.0], [1.0, 1.0]],
            "reference": [[-1.0, -1.0], [1.0, 1.0]],
            "distance": far,
            "size": 100.0,
            "warned": warned,
            "seconds": 1.0,
        }

    # One in ten does not hold one of its two true values, is off, and was warned of.
    records = [
        record(problem, "physics", seed, 0.5 if seed == 9 else -1.0, seed == 9, 0.4 * (seed == 9))
        for problem in ("beam", "focus")
        for seed in range(10)
    ]
    found = tables(records, Ridges(out=tmp_path))["targets"].text.splitlines()[2:]
    verdicts = {text.split(" | ")[0].strip("| "): text.split("**")[1] for text in found}
    assert verdicts == dict.fromkeys(("P1", "P2", "P3", "P4", "P5"), "met")
    silent = [{**each, "warned": not each["warned"]} for each in records]
    found = tables(silent, Ridges(out=tmp_path))["targets"].text
    assert "of 2" in found
    assert found.count("missed") == 2


@pytest.mark.slow
def test_a_run_of_two_cases(tmp_path):
    settings = Settings(compared=0, long=0)
    main(Ridges(out=tmp_path, runs=2, jobs=1, only=("beam", "focus"), settings=settings))
    assert "calibrated physics" in (tmp_path / "tables.md").read_text()


def test_a_run_of_a_textbook_case(tmp_path):
    main(Parameters(out=tmp_path, runs=2, jobs=1, only=("smooth", "physics")))
    assert "| calibrated physics | slope | 2 |" in (tmp_path / "tables.md").read_text()
