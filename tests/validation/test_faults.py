"""A physics that is obviously off is said to be, with the cause; a crude one is not."""

import pytest
import torch

from gpadjust.core.data import Data
from gpadjust.physics import as_physics
from gpadjust.validation.faults import fault_of
from tests.systems import line


def law(X):
    return torch.sin(6 * X[:, :1]) + X[:, :1]


X = line(12, 0.05)
Y = law(X) + 0.01 * torch.cos(40 * X)


def warm(X):
    return 280 + 5 * X[:, :1]


def said(X, Y, physics):
    """The texts on the faults of all outputs."""
    data, values = Data.read(X, Y, None, None), as_physics(physics)(X)
    faults = zip(data.output_names, values.mT, strict=True)
    faults = [(name, fault_of(data, j, f)) for j, (name, f) in enumerate(faults)]
    return "; ".join(f"{name}: {fault.text}" for name, fault in faults if fault)


@pytest.mark.parametrize(
    ("physics", "cause", "more"),
    [
        (lambda X: 1000 * law(X), "it is about 1,000 times too large", "; are its units"),
        (lambda X: law(X) / 1000, "it is about 1,000 times too small", "; are its units"),
        (lambda X: -law(X), "it is of the opposite sign", " (correlation -1.00)."),
        (lambda X: -1000 * law(X), "it is of the opposite sign", " (correlation -1.00), and about"),
        (lambda X: law(X) + 2e4, "it is about 20000 K above the observations", "."),
        (lambda X: law(X) - 273, "it is about 273 K below the observations", "."),
    ],
)
def test_the_cause_is_told_and_a_headline(physics, cause, more):
    data = Data.read(X, Y, None, None)._replace(output_names=("T [K]",))
    fault = fault_of(data, 0, physics(X)[:, 0])
    assert fault.cause == cause
    assert cause + more in fault.text


def test_the_error_is_told():
    text = said(X, 1e3 * Y, lambda X: 1e3 * law(X) + 3e4)
    assert "root mean square error of 30000, where the observations" in text
    assert "standard deviation of 526: it is about 30000 above the observations." in text


def test_a_crude_physics_is_not_complained_of():
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


def test_outputs_are_judged_one_by_one_by_five_observations():
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
def test_scaled_inputs_and_targets_are_asked_about(correction):
    scaled = (X - X.mean()) / X.std(correction=correction)
    text = said(scaled, Y, law)
    assert "are the inputs scaled? Each column of them has mean 0 and standard deviation 1" in text
    data = Data.read(scaled, Y, None, None)
    assert fault_of(data, 0, law(scaled)[:, 0]).cause == "it reads scaled inputs"
    assert said(scaled, Y, lambda Z: law(X.mean() + Z * X.std(correction=correction))) == ""
    assert said(scaled + 0.01, Y, law) == ""
    assert said(torch.cat([scaled, 0 * X], -1), Y, law)
    y = warm(X)
    text = said(X, (y - y.mean()) / y.std(correction=correction), warm)
    assert "it is about 283 above the observations. The observations were standardised" in text
