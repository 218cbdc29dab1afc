"""Inputs that were measured with noise, by the argument `train_Xvar`."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust import CKA, CalibratedPhysics, fit, load, save
from gpadjust.models.noisy_inputs import NoisyInputs
from gpadjust.models.training_data import training_data
from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, PhysicsError, Unknown
from gpadjust.report import report
from gpadjust.validation import leave_one_out
from tests.systems import refused

SD = 0.05
QUICK = partial(fit, method="map", num_starts=2, num_screened=8)
TEST = torch.linspace(0.05, 0.95, 41, dtype=torch.float64).unsqueeze(-1)


def f_p(X):
    return torch.sin(6 * X[..., :1])


def truth(X):
    return 1.2 * f_p(X) + X.square()


def forrester(X):
    return (6 * X - 2).square() * torch.sin(12 * X - 4)


def half_of_it(X):
    return 0.5 * forrester(X) + 10 * (X - 0.5) - 5


def case(seed, truth=truth):
    draw = torch.Generator().manual_seed(seed)
    true = torch.rand(30, 1, generator=draw, dtype=torch.float64)
    X, Y = (
        values + sd * torch.randn(30, 1, generator=draw, dtype=torch.float64)
        for values, sd in ((true, SD), (truth(true), 0.02))
    )
    return X, Y


@pytest.fixture
def data():
    return case(3)


def test_moments_of_physics_and_true_inputs(data):
    X, Y = data
    model = CKA(X, Y, physics=f_p, train_Xvar=SD**2, outcome_transform=None)
    model.eval()
    noisy = model.noisy_inputs
    mean, variance = noisy._moments(model, of_prior=True)
    draws = noisy.points + noisy.spread * torch.randn(200_000, 30, 1, dtype=torch.float64)
    values = f_p(draws).squeeze(-1)
    assert torch.allclose(mean, values.mean(0) - f_p(noisy.points)[:, 0], atol=3e-3)
    assert torch.allclose(variance, values.var(0), rtol=0.04, atol=1e-3)
    slope = 6 * torch.cos(6 * noisy.points)[:, 0]
    steep = slope.abs() > 4
    assert torch.allclose(variance[steep], (slope * noisy.spread[:, 0])[steep].square(), rtol=0.2)
    noisy = NoisyInputs.of(SD**2, training_data(X, Y))
    total = noisy.points.var(0) + noisy.spread.square().mean(0)
    assert total.item() == pytest.approx((X.var(0) - SD**2).item(), rel=1e-9)
    some = torch.zeros_like(X)
    some[:10] = SD**2
    noisy = NoisyInputs.of(some, training_data(X, Y))
    assert torch.equal(noisy.points[10:], X[10:])
    assert not noisy.spread[10:].any()


@pytest.mark.slow
def test_it_is_nearer_than_what_ignores_it():
    ratios = []
    for seed in range(3):
        off = []
        for options in ({}, {"train_Xvar": SD**2}):
            model = CKA(*case(seed, forrester), physics=half_of_it, **options)
            QUICK(model)
            off.append((model.predict(TEST).mean - forrester(TEST)).square().mean().sqrt().log())
        ratios.append(off[1] - off[0])
    assert sum(ratios) / 3 < -0.2


@pytest.mark.slow
def test_it_works_through_the_house(data, tmp_path):
    X, Y = data
    model = CKA(X, Y, physics=f_p, train_Xvar=[SD**2])
    QUICK(model)
    assert model.noise.rows.added.max() > 10 * model.noise.rows.added.min()
    found = model.data()
    assert torch.equal(found["train_X"], X)
    assert torch.allclose(found["train_Y"], Y)
    assert torch.allclose(found["train_Xvar"], torch.full_like(X, SD**2))
    loo = leave_one_out(model)
    assert torch.allclose(loo.Y, Y)
    assert torch.equal(loo.X, X)
    assert 0.8 <= loo.score().coverage.item() <= 1
    more = model.condition_on_observations(TEST[:1], truth(TEST[:1]) + 1)
    assert more.predict(TEST[:1]).mean > model.predict(TEST[:1]).mean
    assert more.data()["train_Xvar"].flatten()[-1] == 0  # later inputs are exact
    assert "noise" in model.summary()
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", physics=f_p)
    for ours, theirs in zip(again.interval(TEST), model.interval(TEST), strict=True):
        assert torch.allclose(ours, theirs)
    assert report(model, tmp_path / "page.html").stat().st_size > 10_000


@pytest.mark.slow
def test_no_noise_changes_nothing_and_samples_are_saved(data, tmp_path):
    plain, model = CKA(*data, physics=f_p), CKA(*data, physics=f_p, train_Xvar=0.0)
    for each in (plain, model):
        QUICK(each)
    assert torch.allclose(plain.predict(TEST).mean, model.predict(TEST).mean, atol=1e-2)
    model = CKA(*data, physics=f_p, train_Xvar=SD**2)
    fit(model, num_starts=2, num_screened=8, num_draws=32)
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt", physics=f_p)
    assert torch.allclose(again.predict(TEST).mean, model.predict(TEST).mean)


def test_an_unknown_parameter_is_nearer_to_the_truth():
    draw = torch.Generator().manual_seed(0)
    true = torch.rand(200, 1, generator=draw, dtype=torch.float64)
    X = true + 0.1 * torch.randn(200, 1, generator=draw, dtype=torch.float64)
    line = FunctionPhysics(lambda X, p: p.a * (X[:, 0] - 0.5), unknowns={"a": Unknown(1.0, sd=2.0)})
    Y = 2 * (true - 0.5) + 0.02 * torch.randn(200, 1, generator=draw, dtype=torch.float64)
    found = []
    for options in ({}, {"train_Xvar": 0.01}):
        model = CalibratedPhysics(X, Y, physics=line, **options)
        QUICK(model)
        found.append(model.input_transform.draws.mean().item())
    assert found[0] < 1.85  # by 12 %, as errors in variables have it
    assert abs(found[1] - 2) < 0.1


def test_a_black_box_that_cannot_be_asked_everywhere():
    X = torch.linspace(0, 1, 12, dtype=torch.float64).unsqueeze(-1)

    def root(X):
        if (X < 0).any():
            raise ValueError("no root")
        return np.sqrt(X[:, :1])

    model = CKA(X, X.sqrt() + 0.1, physics=BlackBoxPhysics(root), train_Xvar=1e-3)
    QUICK(model)
    assert model.noise.rows.added.argmax() <= 1  # where the root is steep
    never = BlackBoxPhysics(lambda X: np.where(np.isin(X, model.noisy_inputs.points), X, np.nan))
    with pytest.raises(PhysicsError):
        QUICK(CKA(X, X, physics=never, train_Xvar=1e-3))


def test_a_frame_and_bad_variances(data):
    X, Y = data
    for given, says in (
        (-1.0, "not to be negative"),
        ([1e-3, 1e-3], "one number"),
        (1.0, "not standard deviations"),
        (float("nan"), "finite"),
    ):
        refused(ValueError, says, CKA, X, Y, physics=f_p, train_Xvar=given)
    batch = [each.expand(2, -1, -1) for each in data]
    refused(ValueError, "one data set", CKA, *batch, physics=f_p, train_Xvar=1e-3)
    frame = pd.DataFrame(X.numpy(), columns=["length"])
    model = CKA(frame, Y, physics=f_p, train_Xvar=pd.DataFrame({"length": np.full(30, SD**2)}))
    assert model.input_names == ("length",)
