"""What a model says of itself, and its intervals."""

import re

import numpy as np
import pandas as pd
import pytest
import torch
from botorch.models.transforms import Normalize
from gpytorch.kernels import RBFKernel, ScaleKernel
from torch import nn
from torch.distributions import MultivariateNormal, Normal

from gpadjust import (
    CKA,
    CalibratedPhysics,
    FunctionPhysics,
    Unknown,
    VariationalCKA,
    ZeroMeanGP,
    fit,
)
from gpadjust.models.parameters import hyperparameters
from tests.systems import holding, line, normal, refused, uniform


def crude(X):
    return X.sum(-1, keepdim=True) + 1


def numbers(text, label):
    return [float(found) for found in re.findall(label + r" (-?[\d.e+-]+)", text)]


@pytest.mark.filterwarnings("ignore::gpadjust.PhysicsWarning")
def test_numbers_are_in_the_users_units(uniform):
    X = torch.stack([100 * uniform(8, 2)[:, 0], uniform(8, 2)[:, 1]], dim=-1)
    Y = 1e3 * (crude(X) + uniform(8, 1))
    model = CKA(X, Y, physics=crude, input_transform=Normalize(2))
    rho, delta = (term.kernel for term in model.terms)
    scale = model.outcome_transform.stdvs.item()
    text = model.summary()
    assert repr(model) in text
    assert repr(model) == "CKA of 'crude': 8 points, 2 inputs, 1 output, not fitted"
    with torch.no_grad():
        ranges = (X.amax(0) - X.amin(0)).tolist()
        lengths = [f"lengthscale of x{i + 1}: {0.5 * ranges[i]:.4g}" for i in range(2)]
        assert all(text.count(length) == 2 for length in lengths)
        sds = [rho.outputscale.sqrt().item(), scale * delta.outputscale.sqrt().item()]
        assert numbers(text, "\n    sd") == pytest.approx(sds, rel=1e-3)
        noise = scale * model.likelihood.noise.sqrt().item()
        assert numbers(text, "noise: sd") == pytest.approx([noise], rel=1e-3)
        inputs = model.train_inputs[0]
        covariance = model.covar_module(inputs).to_dense() + model.likelihood.noise * torch.eye(8)
        targets = MultivariateNormal(crude(X)[:, 0], scale**2 * covariance)
        expected = targets.log_prob(Y[:, 0]).item()
        alone = (Y - crude(X)).square().mean().sqrt().item()
    assert numbers(text, "physics alone: RMSE") == pytest.approx([alone], rel=5e-3)
    assert text.splitlines()[2].endswith(f"(sd of the targets {Y.std():.3g})")
    assert numbers(text, "log likelihood") == pytest.approx([expected], rel=1e-3)


def test_bounds_learnt_means_and_rounding_are_told(uniform, monkeypatch):
    X = uniform(8, 1)
    model = CKA(X, crude(X) + X.square(), physics=crude, rho_mean="learn")
    assert "rho: learnt mean 1" in model.summary()
    assert "at its" not in model.summary()
    model.terms[0].kernel.base_kernel.lengthscale = 1e3 * (X.max() - X.min()).item()
    assert model.summary().count("(at its upper bound)") == 1
    model = ZeroMeanGP(X, X)
    monkeypatch.setattr(ZeroMeanGP, "term_mean", lambda *args: 7e-19)
    assert "f: mean 0\n" in model.summary()


def test_intervals_also_of_a_mixture(uniform):
    X, Z = uniform(8, 1), uniform(5, 1, seed=1)
    model = CKA(X, crude(X) + X.sin(), physics=crude)
    mean, variance = model.predict(Z, observation_noise=True)
    low, high = model.interval(Z, 0.9, observation_noise=True)
    torch.testing.assert_close(low, mean - 1.6448536269514722 * variance.sqrt())
    torch.testing.assert_close(high, mean + 1.6448536269514722 * variance.sqrt())
    for level in (0.0, 1.0, 95, "95 %"):
        refused((TypeError, ValueError), "level must be", model.interval, Z, level)
    model = CKA(X, crude(X) + X.sin(), physics=crude)
    holding(model, 0.0, 1.0)
    assert "2 samples" in repr(model)
    assert " to " in model.summary()
    posterior = model.posterior(Z)
    for end, level in zip(model.interval(Z), (0.025, 0.975), strict=True):
        share = Normal(posterior.mean, posterior.variance.sqrt()).cdf(end.unsqueeze(-3)).mean(-3)
        torch.testing.assert_close(share, torch.full_like(share, level))


def test_parameters_of_the_physics():
    X = line(12)
    unknowns = {"slope": Unknown(1.0, sd=1.0, unit="m/s"), "rest": Unknown(1.5, bounds=(1.0, 2.0))}
    law = FunctionPhysics(lambda X, p: p.slope * X[:, 0] + p.rest, unknowns=unknowns)
    noise = 0.05 * normal(12, 1)
    model = CalibratedPhysics(X, 2 * X + 0.9 + noise, 0.05**2, physics=law)
    fit(model)
    text = model.summary()
    assert re.search(r"slope: 1\.\d+ \(1\.\d+ to \d\.\d+\) m/s\n", text)
    assert re.search(r"rest: 1\.0\d* \(1.* to 1\.\d+\), at the bound 1\n", text)


@pytest.mark.parametrize("normalize", [False, True])
def test_a_kernel_that_reads_some_inputs(uniform, normalize):
    X = uniform(9, 3) * torch.tensor([1.0, 10.0, 1000.0])
    ranges = X.amax(0) - X.amin(0)
    kernel = ScaleKernel(RBFKernel(ard_num_dims=2, active_dims=(2, 0))).double()
    options = {"input_transform": Normalize(3)} if normalize else {}
    model = CKA(X, X[:, :1], physics=lambda X: X[:, 1:2] / 10, delta_covar_module=kernel, **options)
    rows = [row for row in hyperparameters(model) if row.kind == "lengthscale"]
    typical = torch.ones(2).double() if normalize else ranges[[2, 0]]
    torch.testing.assert_close(rows[-1].size.flatten(), typical)
    kernel.base_kernel.lengthscale = 0.5 * typical
    text = model.summary().split("delta:")[1]
    for i in (2, 0):
        assert f"lengthscale of x{i + 1}: {0.5 * ranges[i]:.4g}" in text
    assert "lengthscale of x2" not in text


def test_samples_without_the_physics_are_said():
    X = uniform(15, 1)
    Y = torch.cat([(6 * X).sin() + X, 2 * (6 * X).sin() + X], -1)

    def physics(X):
        return torch.cat([3 * (1e4 * X).sin(), (6 * X).sin()], -1)

    model = CKA(X, Y, physics=physics)
    fit(model)
    first, second = model.summary().split("y2:")
    assert "the physics is left out in 16 of 16 samples" in first
    assert "rho: none" in first
    assert "left out" not in second
    assert "rho: mean 1" in second


# Rho and delta with their intervals in one call


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


def test_adjustments_of_many_points_and_their_gradients(uniform):
    X = uniform(30, 1)
    Y = X.sin() + X
    many = VariationalCKA(X, Y, physics=torch.sin).adjustments(uniform(20_000, 1))
    assert many["delta"].mean.shape == (20_000, 1)
    refused(ValueError, "level", CKA(X, Y, physics=torch.sin).adjustments, X, level=95)
    X = uniform(6, 1)
    model = CKA(X, X.sin() + X, physics=torch.sin)
    asked = nn.Parameter(uniform(3, 1, seed=1))
    model.adjustments(asked)["delta"].upper.sum().backward()
    assert asked.grad.abs().min() > 0
    assert not model.adjustments(X)["delta"].upper.requires_grad
