"""A formula that is right somewhere, through the whole library."""

import numpy as np
import pandas as pd
import pytest
import torch

from gpadjust import CKA, PhysicsMeanGP, ScaleGP, VariationalCKA, fit, load, save
from gpadjust.models import vanishing_rbf
from gpadjust.physics import FunctionPhysics, Unknown
from gpadjust.validation import leave_one_out
from tests.systems import refused

OPEN = vanishing_rbf({"valve": 1.0})


def law(X, p):
    return p.friction * X[:, 1] ** 2


PIPE = FunctionPhysics(law, unknowns={"friction": Unknown(1.0, factor=2.0)})


@pytest.fixture
def valve(uniform):
    """Loss of pressure in a pipe and a valve, whose loss f_p does not have."""
    X = uniform(16, 2, low=0.2)
    noise = 0.01 * torch.randn(16, 1, generator=torch.Generator().manual_seed(3)).double()
    Y = 2 * X[:, 1:] ** 2 + 0.5 * (1 / X[:, :1] - 1) * X[:, 1:] ** 2 + noise
    return pd.DataFrame(X.numpy(), columns=["valve", "flow"]), pd.DataFrame({"loss": Y[:, 0]})


@pytest.fixture
def at_open(uniform):
    X = uniform(7, 2)
    X[:, 0] = 1.0
    return X


@pytest.mark.slow
def test_the_whole_house(valve, at_open, tmp_path, uniform):
    model = PhysicsMeanGP(*valve, physics=PIPE, covar_module=OPEN)
    fit(model, num_samples=8)
    lower, upper = model.physics_parameters.interval()
    assert lower < 2 < upper
    assert upper - lower < 0.6
    delta = model.delta(at_open)
    assert delta.mean.abs().max() < 1e-9
    assert delta.variance.max() < 1e-9
    assert model.delta(at_open - torch.tensor([0.5, 0.0])).variance.min() > 1e-6
    Z = uniform(5, 2, low=0.2, seed=5)
    values = model.sample_functions(1000, seed=0)(Z)
    mean, variance = model.predict(Z)
    assert (values.mean(0) - mean).abs().max() < 0.2 * variance.max().sqrt()
    torch.testing.assert_close(values.std(0), variance.sqrt(), rtol=0.15, atol=0)
    assert torch.isfinite(leave_one_out(model).mean).all()
    more = model.condition_on_observations(at_open[:2], 2 * at_open[:2, 1:] ** 2)
    assert more.delta(at_open).variance.max() < 1e-9
    assert "friction" in model.summary()
    saved = save(model, tmp_path / "model.pt")
    assert "covar_module" in saved.missing
    again = load(saved.path, physics=PIPE, covar_module=OPEN)
    torch.testing.assert_close(again.predict(Z).mean, mean)
    with pytest.raises(ValueError, match="zero elsewhere"):
        load(saved.path, physics=PIPE, covar_module=vanishing_rbf({"valve": 0.5}))


@pytest.mark.parametrize("structure", ["CKA", "ScaleGP"])
def test_rho_is_its_mean_there(structure, valve, at_open):
    X, Y = valve
    if structure == "ScaleGP":
        model = ScaleGP(X, Y, physics=lambda X: X[:, 1] ** 2, covar_module=OPEN)
    else:
        kernels = {"rho_covar_module": OPEN, "delta_covar_module": OPEN}
        model = CKA(X, Y, physics=lambda X: X[:, 1] ** 2, **kernels)
        mean, variance = model.predict(at_open)
        torch.testing.assert_close(mean, at_open[:, 1:] ** 2, rtol=0, atol=1e-7)
        assert variance.max() < 1e-9
    rho = model.rho(at_open)
    assert (rho.mean - 1).abs().max() < 1e-9
    assert rho.variance.max() < 1e-9


def test_beside_and_for_categories(valve):
    X, Y = valve
    X = X.assign(metal=["brass", "steel"] * 8)
    for where, there in [({"valve": 1.0}, {"valve": 1.0}), ({"metal": 1}, {"metal": "steel"})]:
        kernels = dict.fromkeys(["rho_covar_module", "delta_covar_module"], vanishing_rbf(where))
        model = CKA(X, Y, physics=lambda X: X[:, 1] ** 2, **kernels)
        table = model.adjustments(X.assign(**there))
        assert table["delta upper"].abs().max() < 1e-6
        assert model.adjustments(X)["delta upper"].max() > 0.01


def test_places(valve):
    names = ("valve", "flow")
    for where, expected in [
        ({"flow": [0.0, 1.0]}, [[None, 0.0], [None, 1.0]]),
        ({1: 0.0, "valve": 2}, [[2.0, 0.0]]),
        ({-1: 3}, [[None, 3.0]]),
        (np.array([[1.0, 2.0]]), [[1.0, 2.0]]),
        ([[1.0, 2.0]], [[1.0, 2.0]]),
        (pd.DataFrame({"flow": [4.0]}), [[None, 4.0]]),
    ]:
        found = vanishing_rbf(where)._raw(names)
        numbers = [[None if v != v else v for v in row] for row in found.tolist()]
        assert numbers == expected
    X, Y = valve
    for where, says in (
        ({}, "each column a number"),
        ({"valve": [0.0, 1.0], "flow": [1.0, 2.0, 3.0]}, "each column a number"),
        ({"valve": float("nan")}, "finite"),
        (np.zeros(3), r"points p x d.*\(3,\)"),
        ({"metal": "steel"}, r"category.*level"),
    ):
        refused(ValueError, says, vanishing_rbf, where)
    f_p = {"physics": lambda X: X[:, 1]}
    for where, says in (
        ({"vane": 1.0}, "columns of valve, flow.*'vane'"),
        ({2: 1.0}, "numbers from 0 to 1, got 2"),
        (np.zeros((1, 3)), "points with 2 columns"),
        ({"valve": 1.0}, r"center=0.0.*rho_covar_module"),
    ):
        refused(ValueError, says, CKA, X, Y, **f_p, delta_covar_module=vanishing_rbf(where))
    kernels = {"rho_covar_module": OPEN, "delta_covar_module": OPEN}
    refused(ValueError, r"vanish nowhere.*CKA takes it", VariationalCKA, X, Y, **f_p, **kernels)
