"""Scores of free runs: each step against its own formula, angles, and what was not measured."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm

from gpadjust.dynamics import FreeRun, PhysicsDynamics, StateSpec
from gpadjust.dynamics.base import central_interval
from gpadjust.records import Record, Records
from tests.systems import refused

SPEC = StateSpec(["x", "theta"], ["u"], angles=["theta"])


def run_of(particles, level=0.8):
    """Free runs of given particles."""
    ends = central_interval(particles, level)
    lost = torch.zeros(particles.shape[1:3], dtype=torch.float64)
    mean = particles.mean(0)
    return FreeRun(mean, *ends, particles, lost, SPEC, level, mean[:, 0])


@pytest.fixture
def run(uniform):
    """Of 9 particles, 4 windows and 3 steps, the angle by the edge of a turn."""
    return run_of(uniform(9, 4, 3, 2) + torch.tensor([5.0, math.pi - 0.4]))


@pytest.fixture
def measured(run, uniform):
    """What the particles are about, with angles from -pi to pi, not all of it measured."""
    found = run.mean + 0.8 * uniform(4, 3, 2, low=-1, seed=7)
    found[..., 1] = torch.atan2(found[..., 1].sin(), found[..., 1].cos())
    found[1, 0, 0] = found[2, 1] = found[:, 2, 1] = torch.nan
    return found


def test_each_step_is_scored_by_its_formula(run, measured):
    scores = run.score(measured)
    assert scores.output_names == SPEC.states
    of_states = scores.rmse, scores.median, scores.nlpd, scores.coverage
    assert all(score.shape == (3, 2) for score in of_states)
    assert (run.mean - measured)[..., 1].nan_to_num().max() > math.pi
    for t in range(3):
        for i in range(2):
            rows = [w for w in range(4) if not measured[w, t, i].isnan()]
            if not rows:
                assert all(score[t, i].isnan() for score in of_states)
                continue
            mean, low, high = (x[rows, t, i].numpy() for x in (run.mean, run.lower, run.upper))
            sd, y = run.particles[:, rows, t, i].numpy().std(0, ddof=1), measured[rows, t, i]
            error = y.numpy() - mean
            error -= 2 * math.pi * np.round(error / (2 * math.pi)) if i == 1 else 0
            inside = (low <= mean + error) & (mean + error <= high)
            nlpd = -norm.logpdf(error, 0, sd).mean()
            expected = [np.sqrt(np.mean(error**2)), inside.mean(), nlpd]
            found = [scores.rmse[t, i], scores.coverage[t, i], scores.nlpd[t, i]]
            np.testing.assert_allclose(found, expected)
            # Of an even number torch takes the lower one of the two in the middle.
            assert scores.median[t, i] == pytest.approx(sorted(abs(error))[(len(rows) - 1) // 2])
    assert 0 < scores.coverage.nan_to_num().mean() < 1


def test_the_energy_score_is_a_mean_over_pairs(run, measured):
    units = torch.tensor([0.5, 2.0])
    energy = run.score(measured, units=units).energy
    error = SPEC.change(run.mean, measured)
    for t in range(3):
        expected = []
        for w in range(4):
            y = (run.mean[w, t] + error[w, t]) / units
            if y.isnan().any():
                continue
            points, y = (run.particles[:, w, t] / units).tolist(), y.tolist()
            pairs = [math.dist(a, b) for a in points for b in points]
            expected.append(np.mean([math.dist(x, y) for x in points]) - sum(pairs) / (2 * 9 * 8))
        mean = np.mean(expected) if expected else math.nan
        assert energy[t].item() == pytest.approx(mean, nan_ok=True)


def test_chosen_windows_of_records_are_scored_in_typical_steps():
    spec, x = StateSpec(["x"], ["u"]), torch.arange(13, dtype=torch.float64).unsqueeze(-1)
    windows = Records(Record(x[:, 0], 2 * x, torch.ones_like(x)), spec).windows(3)
    assert windows.states[..., 0].tolist() == [
        [6.0 * w + 2 * t for t in range(4)] for w in range(4)
    ]
    late = windows.subset(windows.states[:, 0, 0] > 8)
    assert late.initial_states.flatten().tolist() == [12, 18]
    assert torch.equal(windows.subset(torch.tensor([3, 2])).measured, late.measured.flip(0))
    slow = PhysicsDynamics(spec, lambda X: X[:, :1] + 1.8 * X[:, 1:])
    scores = slow.free_run(late.initial_states, late.actions).score(late.measured)
    for errors in (scores.rmse[:, 0], scores.median[:, 0], 2 * scores.energy):
        np.testing.assert_allclose(errors, [0.2, 0.4, 0.6])
    assert scores.nlpd.isnan().all()


def test_horizons_are_rows_of_all_steps(run, measured):
    whole, some = run.score(measured), run.score(measured, horizons=[3, 1])
    for name in ("rmse", "median", "nlpd", "coverage", "energy"):
        chosen = getattr(some, name)
        torch.testing.assert_close(getattr(whole, name)[[0, 2]], chosen, equal_nan=True)
        torch.testing.assert_close(getattr(whole[2], name), chosen[1], equal_nan=True)


REFUSED = [
    ({"horizons": ()}, ValueError, "different numbers of steps"),
    ({"horizons": 5}, ValueError, r"different numbers of steps.*\(1, 5, 15\), got 5"),
    ({"horizons": (3, 3)}, ValueError, "different numbers"),
    ({"horizons": (0, 3)}, ValueError, "each horizon must be at least 1; found 0"),
    ({"horizons": (1, 4)}, ValueError, "at most the 3 steps of the runs, got 4"),
    ({"units": torch.zeros(2)}, ValueError, "finite and positive"),
    ({"units": torch.ones(3)}, ValueError, "Expected units of shape 2, an entry for each"),
    ({"units": "metres"}, TypeError, "Expected units to be real numbers"),
]


def test_options_out_of_range(run, measured):
    for options, error, words in REFUSED:
        refused(error, words, run.score, measured, **options)
    refused(ValueError, r"shape .*\(4, 3, 2\).*got shape \(4, 2, 2\)", run.score, measured[:, 1:])


def test_particles_without_spread_say_nothing_of_errors(run, measured):
    particles = run.particles.clone()
    particles[:, 3, 1] = particles[:1, 3, 1] * (1 + 1e-13 * torch.rand(9, 1))  # rounding errors
    scores, before = run_of(particles).score(measured), run.score(measured)
    for name in ("coverage", "nlpd"):
        some, others = getattr(scores, name), getattr(before, name)
        assert some[1].isnan().all()
        torch.testing.assert_close(some[::2], others[::2], equal_nan=True)
    assert scores.rmse[1].isfinite().all()


def test_windows_without_particles_are_left_out_of_what_judges_these(run, measured):
    """As where the physics fails, so that the noise is not known."""
    particles, units = run.particles.clone(), torch.ones(2).double()
    particles[:, 0] = torch.nan
    some = run_of(particles)._replace(mean=run.mean).score(measured, units=units)
    rest = run_of(run.particles[:, 1:]).score(measured[1:], units=units)
    torch.testing.assert_close(some.rmse, run.score(measured).rmse, equal_nan=True)
    for name in ("coverage", "nlpd", "energy"):
        torch.testing.assert_close(getattr(some, name), getattr(rest, name), equal_nan=True)
