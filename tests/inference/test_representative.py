"""A few draws that predict as all do."""

import pytest
import torch

from gpadjust import CKA
from gpadjust.inference import register_priors
from gpadjust.inference.representative import LeftOut, disagreement, left_out, representative
from gpadjust.inference.targets import LogPosterior
from gpadjust.validation import leave_one_out


def drawn(number, n=5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    options = {"generator": generator, "dtype": torch.float64}
    mean = torch.randn(number, 1, n, **options)
    return LeftOut(mean, 0.1 + torch.rand(number, 1, n, **options)), mean[..., :2]


def test_predictions_are_those_of_leave_one_out(uniform):
    X = uniform(9, 2)
    model = CKA(X, X.sum(-1, keepdim=True).sin(), physics=lambda X: X[:, :1])
    register_priors(model)
    expected = leave_one_out(model)
    target = LogPosterior(model)
    found = left_out(target, target.parameters.current())
    unit = (expected.variance.squeeze(-1) / found.variance[0, 0]).sqrt()
    torch.testing.assert_close(unit, unit[:1].expand_as(unit), rtol=1e-5, atol=0.0)
    away = (expected.mean - expected.Y).squeeze(-1)
    torch.testing.assert_close(found.mean[0, 0] * unit, away, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("number", [1, 4, 16])
def test_a_mixture_of_few_is_that_of_all(number):
    predicted, positions = drawn(200)
    weights = torch.full((200, 1), 1 / 200, dtype=torch.float64)
    rows = representative(predicted, positions, weights, number)
    assert rows.shape == (number, 1)
    assert len({*rows.flatten().tolist()}) == number
    expected, _ = predicted.mixture(weights)
    error, at_random = (
        (predicted.mean[each].mean(0) - expected).square().mean()
        for each in (rows[:, 0], torch.arange(number))
    )
    assert error < (0.5 if number == 1 else 0.1) * at_random


def test_weights_are_shares_and_few_draws_are_taken_twice():
    # Two kinds of draws, far apart, a fourth of all of the second kind.
    first, second = (drawn(50, seed=seed) for seed in (0, 1))
    mean = torch.cat([first[0].mean, second[0].mean + 100])
    predicted = LeftOut(mean, torch.cat([first[0].variance, second[0].variance]))
    weights = torch.cat([torch.full((50, 1), 0.75 / 50), torch.full((50, 1), 0.25 / 50)]).double()
    rows = representative(predicted, mean[..., :2], weights, 8)
    assert (rows >= 50).sum() == 2
    assert (rows.diff(dim=0) >= 0).all()
    predicted, positions = drawn(20)
    weights = torch.zeros(20, 1, dtype=torch.float64)
    weights[[3, 8, 11]] = 1 / 3
    rows = representative(predicted, positions, weights, 6)
    assert rows.flatten().bincount(minlength=12)[[3, 8, 11]].tolist() == [2, 2, 2]


def test_halves_that_disagree():
    predicted, _ = drawn(4000)
    weights = torch.full((4000, 1), 1 / 4000, dtype=torch.float64)
    targets = torch.ones(5, dtype=torch.float64)
    assert disagreement(predicted, weights, targets) < 0.05
    predicted.mean[0::2] += 2.0
    # The mean of both is one away from each.
    _, variance = predicted.mixture(weights)
    expected = (1 / variance).mean().sqrt().item()
    assert disagreement(predicted, weights, targets).item() == pytest.approx(expected, rel=0.05)
    assert disagreement(predicted, weights, 1e9 * targets) < 0.01
    predicted, _ = drawn(4000)
    weights = torch.full((4000, 1), 1 / 4000, dtype=torch.float64)
    predicted.mean[0::2] += 2.0
    predicted.mean[..., 1:] = 0.0
    targets = torch.tensor([1.0, *[torch.nan] * 4], dtype=torch.float64)
    observed = LeftOut(*(each[..., :1] for each in predicted))
    expected = disagreement(observed, weights, targets[:1])
    assert expected > 0.3
    torch.testing.assert_close(disagreement(predicted, weights, targets), expected)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_of_two_models_as_many_are_chosen_as_they_have_weight(share):
    """However differently they predict."""
    predicted, positions = drawn(200)
    is_first = torch.arange(200) < 100
    predicted.mean[is_first] += 2.0
    weights = torch.where(is_first, share, 1 - share).unsqueeze(-1).double() / 100
    rows = representative(predicted, positions, weights, 10, is_first)
    assert int(is_first[rows].sum()) == round(10 * share)
