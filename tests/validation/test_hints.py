"""Hints at kinds of data: there where they should be, none of clean data."""

import pytest
import torch

from gpadjust import CKA, compare, fit
from gpadjust.validation import leave_one_out
from gpadjust.validation.hints import _positive, hints

QUICK = {"num_starts": 1, "num_screened": 16}
X = torch.linspace(0, 1, 40, dtype=torch.float64).unsqueeze(-1)


def f_p(X):
    return 10 ** (2 * X[:, :1])


def truth(X):
    return 1.2 * f_p(X) + X[:, :1]


def found(X, Y, **options):
    model = CKA(X, Y, physics=f_p, **options)
    fit(model, "map", **QUICK)
    return hints(model, leave_one_out(model))


@pytest.fixture
def noise():
    return torch.randn_like(X)


def test_clean_data_have_none(noise):
    assert found(X, truth(X)) == []
    assert found(X, truth(X) + 100 + noise) == []


def test_outliers(noise):
    Y = truth(X) + 100 + noise
    Y[7] += 40
    (hint,) = found(X, Y)
    assert hint.startswith("1 observation is farther from the prediction of the others than 6 ")
    assert "(--outliers)" in hint
    assert found(X[:9], Y[:9]) == []  # too few to tell


def test_noise_that_grows(noise):
    (hint,) = [each for each in found(X, truth(X) * (1 + 0.1 * noise)) if "grow" in each]
    assert "likelihood='relative' (--noise relative)" in hint


def test_positive_outputs(noise):
    y = torch.tensor([0.15, 3.0, 262.0]).double()
    (sentence,) = _positive(y, y, 0.01 * y)
    assert "spans 3.2 decades" in sentence
    for own in (-y, y + 100, y[:2]):
        assert _positive(own, own, 0 * own) == []
    (sentence,) = _positive(y + 1, y, torch.full_like(y, 4.0))
    assert "2 of 3 left-out intervals reach below zero" in sentence
    assert "outcome_transform='log' (--positive)" in sentence


def test_categories(noise):
    rig = torch.arange(40).remainder(4).double().unsqueeze(-1)
    inputs, Y = torch.cat([X, rig], -1), truth(X) + 100 + noise
    (hint,) = found(inputs, Y)
    assert "x2 has 4 different values, 0 to 3" in hint
    assert "categorical=['x2'] (--categories x2)" in hint


@pytest.mark.slow
def test_of_a_comparison_each_output_has_its_own(noise):
    Y = torch.cat([truth(X) + noise, truth(X) + 100 + noise], -1)
    Y[7, 1] += 40
    structures = ["zero mean", "CKA"]
    comparison = compare(X, Y, lambda X: f_p(X).expand(-1, 2), structures=structures, **QUICK)
    told = [hint for hint in comparison.hints if "farther" in hint]
    assert len(told) == 1
    assert told[0].startswith("y2: 1 observation is")
    assert told[0] in str(comparison)
