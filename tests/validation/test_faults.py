"""A physics that is obviously off is said to be, with the cause; a crude one is not."""

import pytest
import torch

from gpadjust.core.data import Data
from gpadjust.physics import as_physics
from gpadjust.validation.faults import fault_of
from tests.systems import line


def law(X):
    return torch.sin(6 * X[:, :1]) + X[:, :1]


def warm(X):
    return 280 + 5 * X[:, :1]


@pytest.fixture
def X():
    return line(12, 0.05)


@pytest.fixture
def Y(X):
    return law(X) + 0.01 * torch.cos(40 * X)


def said(X, Y, physics):
    data, values = Data.read(X, Y, None, None), as_physics(physics)(X)
    found = [fault_of(data, j, f) for j, f in enumerate(values.mT)]
    names = [f"{name}: " for name in data.output_names] if len(found) > 1 else [""]
    return "; ".join(name + fault.text for name, fault in zip(names, found, strict=True) if fault)


def test_the_cause_is_told(X, Y):
    for physics, words in (
        (lambda X: 1000 * law(X), "it is about 1,000 times too large; are its units"),
        (lambda X: law(X) / 1000, "it is about 1,000 times too small; are its units"),
        (lambda X: -law(X), "it is of the opposite sign (correlation -1.00)."),
        (lambda X: -1000 * law(X), ", and about 1,000 times too large."),
        (lambda X: law(X) + 273, "it is about 273 above the observations."),
        (lambda X: law(X) - 273, "it is about 273 below the observations."),
    ):
        assert words in said(X, Y, physics)
    text = said(X, 1e3 * Y, lambda X: 1e3 * law(X) + 3e4)
    assert "root mean square error of 30000, where the observations" in text
    assert "standard deviation of 526: it is about 30000 above the observations." in text


def test_the_cause_is_a_headline():
    X = line(12, 0.05)
    data = Data.read(X, 1e3 * law(X), None, None)._replace(output_names=("T [K]",))
    for f, cause in (
        (1e6 * law(X), "it is about 1,000 times too large"),
        (-1e3 * law(X), "it is of the opposite sign"),
        (1e3 * law(X) + 2e4, "it is about 20000 K above the observations"),
    ):
        fault = fault_of(data, 0, f[:, 0])
        assert fault.cause == cause
        assert cause in fault.text
    scaled = Data.read((X - X.mean()) / X.std(), law(X), None, None)
    assert fault_of(scaled, 0, law(scaled.X)[:, 0]).cause == "it reads scaled inputs"


def test_a_crude_physics_is_not_complained_of(X, Y):
    for physics in (
        lambda X: 0.5 * law(X),
        lambda X: 5 * law(X),
        lambda X: 0 * X,
        lambda X: X,
        lambda X: 0.3 - X,
        lambda X: 15 * torch.sin(9 * X).abs(),
    ):
        assert said(X, Y, physics) == ""
    assert said(X, 100 + Y, lambda X: 90 + law(X)) == ""


def test_outputs_are_judged_one_by_one_by_five_observations(X, Y):
    few = Y.clone()
    few[4:] = torch.nan
    both = torch.cat([few, Y], -1)
    text = said(X, both, lambda X: 1000 * law(X).expand(-1, 2))
    assert text.startswith("y2: at the data")
    assert "y1" not in text
    both[4, 0] = Y[4, 0]
    assert said(X, both, lambda X: 1000 * law(X).expand(-1, 2)).startswith("y1: at the data")
    assert said(X, torch.ones_like(Y), lambda X: 1000 * law(X)) == ""


@pytest.mark.parametrize("correction", [0, 1])
def test_scaled_inputs_and_targets_are_asked_about(X, Y, correction):
    scaled = (X - X.mean()) / X.std(correction=correction)
    text = said(scaled, Y, law)
    assert "are the inputs scaled? Each column of them has mean 0 and standard deviation 1" in text
    assert said(scaled, Y, lambda Z: law(X.mean() + Z * X.std(correction=correction))) == ""
    assert said(scaled + 0.01, Y, law) == ""
    assert said(torch.cat([scaled, 0 * X], -1), Y, law)
    Y = warm(X)
    text = said(X, (Y - Y.mean()) / Y.std(correction=correction), warm)
    assert "it is about 283 above the observations. The observations were standardised" in text
