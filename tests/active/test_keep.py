"""Measurements only where limits are kept with a probability."""

from functools import partial

import pytest
import torch
from botorch.acquisition import PosteriorStandardDeviation

from gpadjust import CKA, ZeroMeanGP, fit
from gpadjust.active import Collection, collect, qAdjustmentInformationGain
from gpadjust.active.keep import Keep

BOUNDS = [[0.0], [1.0]]
MOST = 1.5


def steep(X):
    return 3 * X.square()


def below(Y):
    return Y - MOST


def point_fit(model):
    return fit(model, "map", num_starts=2)


def test_a_forbidden_region_is_hardly_entered():
    """Beyond 0.707 the outputs are too large; f_p says so beyond 0.79 only."""
    measured, left_out = [], 0
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        result = collect(
            partial(CKA, physics=lambda X: 2.4 * X.square()),
            lambda X, g=generator: steep(X) + 0.02 * torch.randn(X.shape, generator=g).double(),
            BOUNDS,
            qAdjustmentInformationGain,
            budget=9,
            initial=[[0.0], [0.15], [0.3]],
            keep=below,
            fit=point_fit,
            seed=seed,
        )
        measured.append(result.X[3:])
        left_out += len(result.left_out)
        assert (result.left_out > 0.5).all()
    points = torch.cat(measured)
    assert (steep(points) > MOST).sum() <= 1  # of 12, at a probability of 0.95
    assert points.max() > 0.5
    assert left_out > 0


def test_probabilities_are_those_of_the_normal_distribution():
    X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
    model = ZeroMeanGP(X, torch.cat([X.sin(), X.cos()], -1), torch.full((8, 2), 1e-2).double())
    at = torch.tensor([[0.2], [0.9]], dtype=torch.float64)
    torch.manual_seed(0)
    found = Keep(lambda Y: (Y - 0.8).abs() - 0.2, 0.9).probabilities(model, at)
    mean, variance = model.predict(at, observation_noise=True)
    each = torch.special.ndtr((1.0 - mean) / variance.sqrt())
    each = each - torch.special.ndtr((0.6 - mean) / variance.sqrt())
    assert torch.allclose(found, each.prod(-1), atol=0.05)


def test_an_interrupted_run_goes_on_with_what_was_left_out(tmp_path):
    def made():
        return Collection(
            partial(CKA, physics=lambda X: 2.4 * X.square()),
            BOUNDS,
            PosteriorStandardDeviation,
            initial=[[0.0], [0.3]],
            keep=below,
            fit=point_fit,
            log=tmp_path / "log.jsonl",
        )

    with made() as first:
        first.run(steep, 4)
        before, points = first.left_out, first.ask()
        assert "left out" in repr(first)
    with made() as again:
        assert torch.equal(again.left_out[: len(before)], before)
        assert torch.equal(again.pending, points)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({}, ValueError, "first points must be known as safe"),
        ({"initial": [[0.1]]}, ValueError, "found 1 and 0"),
        ({"initial": [[0.1], [0.2]], "probability": 95}, ValueError, "probability must be"),
        ({"initial": [[0.1], [0.2]], "keep": 1.5}, TypeError, "keep to be callable"),
    ],
)
def test_bad_options_are_refused(options, error, message):
    with pytest.raises(error, match=message):
        Collection(ZeroMeanGP, BOUNDS, PosteriorStandardDeviation, **{"keep": below, **options})


def test_where_nothing_is_safe_it_says_so():
    collection = Collection(
        ZeroMeanGP,
        BOUNDS,
        PosteriorStandardDeviation,
        data=(torch.tensor([[0.0], [0.5], [1.0]]), torch.tensor([[5.0], [6.0], [5.0]])),
        keep=below,
        fit=point_fit,
    )
    with pytest.raises(RuntimeError, match=r"0 of \d+ points as safe with a probability of 0\.95"):
        collection.ask()
