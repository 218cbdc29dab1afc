"""A physics that is obviously off is said to be, with the cause; a crude one is not."""

import warnings

import pytest
import torch

from gpadjust import (
    CKA,
    RRA,
    CalibratedPhysics,
    FunctionPhysics,
    PhysicsMeanGP,
    PhysicsWarning,
    ScaleGP,
    Unknown,
    VariationalCKA,
    ZeroMeanGP,
    load,
    save,
)
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


def said(build, *data, **options):
    """What is warned of when a model is built."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        build(*data, **options)
    assert all(each.category is PhysicsWarning for each in caught)
    return [str(each.message) for each in caught]


OFF = {
    "too large": (lambda X: 1000 * law(X), "f_p is about 1,000 times too large; are its units"),
    "too small": (lambda X: law(X) / 1000, "f_p is about 1,000 times too small; are its units"),
    "sign": (lambda X: -law(X), r"f_p is of the opposite sign \(correlation -1\.00\)\. Look"),
    "both": (lambda X: -1000 * law(X), r"opposite sign .*, and about 1,000 times too large\."),
}


def test_the_cause_is_told(X, Y):
    for physics, says in OFF.values():
        for model in (CKA, RRA, ScaleGP, VariationalCKA):
            with pytest.warns(PhysicsWarning, match=rf"training inputs .*{says}"):
                model(X, Y, physics=physics)


def test_by_how_much_is_told_but_not_of_what_is_learnt(X, Y):
    (text,) = said(PhysicsMeanGP, X, 1e3 * Y, physics=lambda X: 1e3 * law(X) + 3e4)
    assert "root mean square error of 30,000, where the targets" in text
    assert "standard deviation of 526: f_p is about 30,000 above the targets." in text
    (text,) = said(PhysicsMeanGP, X, Y + 300, physics=lambda X: law(X) + 27)
    assert "f_p is about 273 below the targets." in text

    def above(X):
        return law(X) + 30

    for center in ("learn", 0.0):  # on a center the prior mean does not depend
        (text,) = said(CKA, X, Y, physics=above, center=center)
        assert "about 30 above the targets" in text
    assert said(CKA, X, Y, physics=above, delta_mean="learn") == []
    assert said(PhysicsMeanGP, X, Y, physics=above, delta_mean="learn") == []
    assert said(PhysicsMeanGP, X, Y, physics=above, delta_mean=-30.0) == []
    large = OFF["too large"][0]
    for mean in ("learn", 1e-3):
        assert said(CKA, X, Y, physics=large, rho_mean=mean) == []
    assert said(CKA, X, Y, physics=OFF["both"][0], rho_mean="learn") == []
    assert said(ZeroMeanGP, X, 1e6 * Y) == []


def test_a_crude_physics_is_not_warned_of(X, Y):
    crude = {
        "half": lambda X: 0.5 * law(X),
        "five times": lambda X: 5 * law(X),
        "constant": lambda X: 0 * X,
        "another law": lambda X: X,
        "falls instead": lambda X: 0.3 - X,
        "large, and another law": lambda X: 15 * torch.sin(9 * X).abs(),
        "a tenth too low": lambda X: 90 + law(X),
    }
    for name, physics in crude.items():
        targets = 100 + Y if name == "a tenth too low" else Y
        for model in (CKA, PhysicsMeanGP):
            assert said(model, X, targets, physics=physics) == [], (name, model)


def test_batches_several_physics_and_few_observations(X, Y):
    large = OFF["too large"][0]
    assert said(CKA, X[:4], Y[:4], physics=large) == []
    few = Y.clone()
    few[4:] = torch.nan
    both = torch.cat([few, Y], -1)
    (text,) = said(CKA, X, both, physics=lambda X: large(X).expand(-1, 2))
    assert "y2: at the training" in text
    assert "y1" not in text
    few[4] = Y[4]
    both = torch.cat([few, Y], -1)
    (text,) = said(CKA, X, both, physics=lambda X: large(X).expand(-1, 2))
    assert "y1: at the training" in text
    assert said(CKA, X, torch.ones_like(Y), physics=large) == []
    large, both = OFF["too large"][0], torch.stack([Y, 1000 * Y, Y])
    (text,) = said(CKA, X.expand(3, -1, -1), both, physics=large)
    assert "So in 2 of 3 data sets." in text
    assert said(CKA, X, Y, physics=[large, lambda X: X]) == []  # together they may be right
    (text,) = said(CKA, X, Y, physics=[large, lambda X: X], rho_mean=[1.0, 0.0])
    assert "1,000 times too large" in text


@pytest.mark.parametrize("correction", [0, 1])
def test_scaled_inputs_and_targets_are_asked_about(X, Y, correction):
    scaled = (X - X.mean()) / X.std(correction=correction)
    (text,) = said(CKA, scaled, Y, physics=law)
    assert "are the inputs scaled? Each column of them has mean 0 and standard deviation 1" in text
    assert said(CKA, scaled, Y, physics=lambda Z: law(X.mean() + Z * X.std())) == []
    assert said(CKA, scaled + 0.01, Y, physics=law) == []
    assert len(said(CKA, torch.cat([scaled, 0 * X], -1), Y, physics=law)) == 1
    Y = warm(X)
    (text,) = said(PhysicsMeanGP, X, (Y - Y.mean()) / Y.std(correction=correction), physics=warm)
    assert "f_p is about 283 above the targets. The targets were standardised" in text


def test_guesses_and_warnings_that_were_given(X, Y, tmp_path):
    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.size = torch.nn.Parameter(torch.tensor(1000.0, dtype=torch.float64))

        def forward(self, X):
            return self.size * law(X)

    assert said(CKA, X, Y, physics=Net()) == []
    assert len(said(CKA, X, Y, physics=Net().requires_grad_(False))) == 1
    unknowns = {"size": Unknown(1000.0, factor=10.0)}
    guess = FunctionPhysics(lambda X, p: p.size * law(X)[:, 0], unknowns=unknowns)
    assert said(CalibratedPhysics, X, Y, physics=guess) == []
    with pytest.warns(PhysicsWarning) as caught:
        model = CKA(X, Y, physics=OFF["too large"][0])
    assert [each.filename for each in caught] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a lambda cannot be imported
        save(model, tmp_path / "model.pt")
    assert said(load, tmp_path / "model.pt", physics=OFF["too large"][0]) == []
    assert said(model.subset_output, [0]) == []
