"""The core against the models of gpadjust.models, at the same hyper-parameters."""

import pytest
import torch

import gpadjust
from gpadjust import core
from tests.systems import crude


def assert_close(found, expected, tolerance=1e-10):
    size = expected.abs().max().item()
    torch.testing.assert_close(
        found.detach(), expected.detach(), rtol=tolerance, atol=tolerance * size
    )


CASES = {
    "CKA": ({"center": 0.0}, {"center": False, "constants": False}),
    "CKA with a center": ({"center": "mean"}, {"center": True, "constants": False}),
    "given mean": (
        {"center": 0.0, "rho_mean": 1.5},
        {"center": False, "constants": False, "rho_mean": 1.5},
    ),
    "PhysicsMeanGP": ({}, {"constants": False}),
    "ScaleGP": ({}, {"constants": False}),
    "ZeroMeanGP": ({}, {"constants": False}),
}


@pytest.fixture
def pair(data, numbers):
    """`pair(name, known)`: the old model and the new one, with the numbers of the new one."""

    def pair(name, known=False, m=2):
        X, Y = data(num_outputs=m, n=12)
        Y[3, 0] = torch.nan if m > 1 else Y[3, 0]
        Yvar = 0.01 * (1 + X[:, :1]) * torch.ones_like(Y) if known else None
        cls = name if name.endswith("GP") else "CKA"
        physics = {} if cls == "ZeroMeanGP" else {"physics": lambda X: crude(X)[..., :m]}
        own, other = CASES[name]
        old = getattr(gpadjust, cls)(X, Y, Yvar, **physics, **own)
        new = getattr(core, cls)(X, Y, Yvar, **physics, **other)
        u = 0.5 * torch.randn(1, m, new.table.size, dtype=torch.float64)
        for i, name in enumerate(
            row.name for row in new.table.own for _ in range(row.location.shape[-1])
        ):
            u[..., i] *= not name.endswith("center")  # the mean of the physics
        new.set_draws(u)
        values, unit = numbers(new), old.units()[1].reshape(m)
        for term in old.terms:
            start = f"{term.name}.kernel."
            if term.kernel is None or f"{start}lengthscale" not in values:
                continue
            scale = values[f"{start}outputscale"][0, :, 0]
            scale = scale if term.name == "rho" else scale / unit.square()
            base = term.kernel.base_kernel
            base.lengthscale = values[f"{start}lengthscale"][0].reshape(base.lengthscale.shape)
            term.kernel.outputscale = scale.reshape(term.kernel.outputscale.shape)
        if not known:
            noise = values["noise.variance"][0, :, 0] / unit.square()
            old.likelihood.noise = noise.reshape(old.likelihood.noise.shape)
        return old.eval(), new.eval()

    return pair


@pytest.mark.parametrize("m", [1, 2])
@pytest.mark.parametrize("known", [False, True], ids=["learnt", "known"])
@pytest.mark.parametrize("name", CASES)
def test_the_same_posterior(name, known, m, pair, uniform):
    old, new = pair(name, known, m)
    Z = uniform(5, 2, high=2.0, seed=5)
    new_X, new_Y = uniform(2, 2, seed=6), crude(uniform(2, 2, seed=6))[:, :m]
    noise = {"noise": torch.full_like(new_Y, 0.02)} if known else {}
    later = [model.condition_on_observations(new_X, new_Y, **noise) for model in (old, new)]
    for one, other in ((old, new), later):
        asks = [lambda model: model.predict(Z), lambda model: model.posterior(Z)]
        asks += [
            lambda model, name=term.name: model.term(name, Z) for term in new.terms if term.varies
        ]
        for ask in asks:
            assert_close(ask(other).mean, ask(one).mean)
            assert_close(ask(other).variance, ask(one).variance)
        joint = (model.posterior(Z).distribution.covariance_matrix for model in (other, one))
        assert_close(*joint)
        seen = ~other.data.Y.isnan()
        (shift, unit), (mean, variance) = one.units(), one.left_out()
        found, spread = (v[0] for v in other.left_out())
        assert_close(found[seen], (mean * unit + shift).reshape(m, -1).mT[seen])
        assert_close(spread[seen], (variance * unit.square()).reshape(m, -1).mT[seen])
    assert_close(new.predict(Z, True).variance, old.predict(Z, True).variance)
