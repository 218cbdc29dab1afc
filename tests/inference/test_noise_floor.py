"""Learnt noise is at least 1e-11 of the mean square of the targets' residual, in every fit."""

import pytest
import torch

from gpadjust import CKA, RRA, PhysicsMeanGP, ScaleGP, ZeroMeanGP, fit
from gpadjust.inference.warm_start import warm_start
from gpadjust.models.parameters import KINDS
from tests.systems import line

pytestmark = pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.OptimizationWarning")
QUICK = {"num_screened": 32, "num_starts": 4}


def crude(X):
    return (6 * X).sin() + 2


def of(Y):
    """The physics, once for each output."""
    return lambda X: crude(X).expand(*X.shape[:-1], Y.shape[-1])


X = line(8)
BUILD = {
    "ZeroMeanGP": ZeroMeanGP,
    "PhysicsMeanGP": lambda X, Y: PhysicsMeanGP(X, Y, physics=of(Y)),
    "ScaleGP": lambda X, Y: ScaleGP(X, Y, physics=of(Y)),
    "CKA": lambda X, Y: CKA(X, Y, physics=of(Y)),
    "learnt means": lambda X, Y: CKA(X, Y, physics=of(Y), rho_mean="learn", delta_mean="learn"),
    "RRA": lambda X, Y: RRA(X, Y, physics=of(Y), num_features=16),
}
# All without noise, at which a fit would take it to nothing.
TARGETS = {
    "in the class": 2 * crude(X) + X,
    "a scaled physics": 2 * crude(X),
    "a shifted physics": crude(X) + 1e-6,
    "the physics": crude(X),
    "of outputs of many sizes": torch.cat([1e-6 * X.exp(), 2 * crude(X), 1e6 * X.square()], -1),
    "constant": torch.full_like(X, 3.0),
}


def floors(model, Y):
    """The least noise of each output, in the user's units; 0 where all targets are met exactly."""
    residual = Y if isinstance(model, ZeroMeanGP) else Y - crude(X[: len(Y)])
    size, spread = residual.square().nanmean(0), (Y - Y.nanmean(0)).square().nanmean(0)
    size = size.where(spread < 1e-20, size.minimum(spread))
    return KINDS["noise"].bounds[0] * size


def assert_above(model, Y):
    noise = model.likelihood.noise.flatten() * model.outcome_transform.stdvs.square().flatten()
    assert (noise >= floors(model, Y) * (1 - 1e-9)).all()


CASES = [("CKA", "the physics"), ("ZeroMeanGP", "constant"), ("ScaleGP", "a shifted physics")]
CASES += [("CKA", "of outputs of many sizes"), ("learnt means", "in the class")]
MORE = [("CKA", targets) for targets in TARGETS] + [(kind, "in the class") for kind in BUILD]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "targets"), sorted({*CASES, *MORE}))
def test_one_fit_after_the_other(kind, targets):
    Y = TARGETS[targets]
    model = BUILD[kind](X, Y)
    for options in ({}, {}, {"num_screened": 0}):
        fit(model, "map", **QUICK | options)
        assert_above(model, Y)


def test_with_missing_targets_and_from_a_start_below_it():
    Y = TARGETS["of outputs of many sizes"].clone()
    Y[1, 0] = Y[4:6, 2] = torch.nan
    model = CKA(X, Y, physics=of(Y))
    fit(model, "map", **QUICK)
    assert_above(model, Y)
    Y = TARGETS["in the class"]
    model = CKA(X, Y, physics=of(Y))
    model.likelihood.noise = 1e-20
    fit(model, "map", num_screened=0)
    assert_above(model, Y)


@pytest.mark.parametrize("num_screened", [0, pytest.param(32, marks=pytest.mark.slow)])
def test_from_a_model_of_much_smaller_residuals(num_screened):
    few, Y = crude(X[:5]) + 1e-3 * X[:5], TARGETS["in the class"]
    previous, model = CKA(X[:5], few, physics=crude), CKA(X, Y, physics=of(Y))
    fit(previous, "map", **QUICK)
    warm_start(model, previous)
    fit(model, "map", num_screened=num_screened)
    assert_above(model, Y)


@pytest.mark.filterwarnings("ignore::gpadjust.inference.SamplingWarning")
@pytest.mark.parametrize(
    "targets", ["in the class", pytest.param("of outputs of many sizes", marks=pytest.mark.slow)]
)
def test_of_samples(targets):
    Y = TARGETS[targets]
    model = CKA(X, Y, physics=of(Y))
    fit(model, num_draws=256, **QUICK)
    noise = model.likelihood.noise.squeeze(-1).reshape(16, -1)
    noise = noise * model.outcome_transform.stdvs.square().reshape(-1, Y.shape[-1])[0]
    assert (noise >= floors(model, Y) * (1 - 1e-9)).all()
