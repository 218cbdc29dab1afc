"""Rho and delta with their intervals in one call."""

import numpy as np
import pandas as pd
import pytest
import torch
from torch import nn

from gpadjust import CKA, PhysicsMeanGP, VariationalCKA, fit
from tests.systems import refused


@pytest.mark.parametrize("num_outputs", [1, 2])
@pytest.mark.parametrize("sampled", [False, True])
def test_they_are_the_moments_of_the_terms(sampled, num_outputs, data, build, uniform):
    X, Y = data(num_outputs=num_outputs)
    model, Z = build("CKA", X, Y), uniform(7, 2)
    if sampled:
        fit(model, num_samples=4)
    found = model.adjustments(Z, level=0.9)
    assert [*found] == ["rho", "delta"]
    for name, each in found.items():
        term = model.term(name, Z)
        torch.testing.assert_close(each.mean, term.mean, rtol=1e-9, atol=1e-9)
        assert each.lower.shape == each.upper.shape == (7, num_outputs)
        if not sampled:
            half = 1.6448536269514722 * term.variance.sqrt()
            torch.testing.assert_close(each.upper, term.mean + half, rtol=0, atol=1e-6)
            torch.testing.assert_close(each.lower, term.mean - half, rtol=0, atol=1e-6)


def test_as_the_inputs_came(data, build, uniform):
    X, Y = data(num_outputs=2)
    Z = uniform(5, 2).numpy()
    frame = pd.DataFrame(Z, columns=["speed", "load"], index=[*"abcde"])
    named = pd.DataFrame(X.numpy(), columns=frame.columns)
    model = build("CKA", named, pd.DataFrame(Y.numpy(), columns=["u", "v"]))
    table, arrays = model.adjustments(frame), model.adjustments(Z)
    assert [*table.index] == [*"abcde"]
    assert len(table.columns) == 12
    assert isinstance(arrays["rho"].lower, np.ndarray)
    np.testing.assert_array_equal(table["rho of v lower"], arrays["rho"].lower[:, 1])
    alone = build("PhysicsMeanGP", named, Y[:, :1]).adjustments(frame)
    assert [*alone.columns] == ["delta mean", "delta lower", "delta upper"]


def test_many_points_and_other_models(uniform):
    X = uniform(30, 1)
    Y = X.sin() + X
    for make in (CKA, PhysicsMeanGP, VariationalCKA):
        many = make(X, Y, physics=torch.sin).adjustments(uniform(20_000, 1))
        assert many["delta"].mean.shape == (20_000, 1)
    refused(ValueError, "level", CKA(X, Y, physics=torch.sin).adjustments, X, level=95)


def test_gradients_reach_the_inputs(uniform):
    X = uniform(6, 1)
    model = CKA(X, X.sin() + X, physics=torch.sin)
    asked = nn.Parameter(uniform(3, 1, seed=1))
    model.adjustments(asked)["delta"].upper.sum().backward()
    assert asked.grad.abs().min() > 0
    assert not model.adjustments(X)["delta"].upper.requires_grad
