"""Variances where there is (next to) no noise, against arithmetic with 60 digits."""

import mpmath as mp
import pytest
import torch

from gpadjust.core import CKA, MATERN12, Stationary, ZeroMeanGP
from tests.systems import line, ripple

EPS = 2.0**-52


def variances(model, X, Z):
    """Posterior variances of f, rho and delta at Z, in the user's units."""
    x, z = ([mp.mpf(v) for v in values.flatten().tolist()] for values in (X, Z))
    values = {name: [mp.mpf(v) for v in v.flatten().tolist()] for name, v in model.values.items()}
    unit, n = mp.mpf(model.unit.item()), len(x)
    f, g = (mp.diag([mp.mpf(v) / unit for v in ripple(P).flatten().tolist()]) for P in (X, Z))

    def k(name, A, B):
        (length,), (scale,) = (values[f"{name}.kernel.{n}"] for n in ("lengthscale", "outputscale"))
        return scale * mp.matrix([[mp.exp(-(((a - b) / length) ** 2) / 2) for b in B] for a in A])

    K = f * k("rho", x, x) * f + k("delta", x, x)
    K += (values["noise.variance"][0] + mp.mpf(1e-11)) * mp.eye(n)
    K += mp.mpf(max(100, n) * EPS) * mp.diag([K[i, i] for i in range(n)])  # the nugget
    inverse = mp.inverse(K)
    rho, delta = k("rho", z, x) * f, k("delta", z, x)
    k_rho, k_delta = k("rho", z, z), k("delta", z, z)
    for prior, cross, size in (
        (g * k_rho * g + k_delta, g * rho + delta, unit**2),
        (k_rho, rho, 1),
        (k_delta, delta, unit**2),
    ):
        left = prior - cross * inverse * cross.T
        yield torch.tensor([[float(left[i, i] * size)] for i in range(len(z))], dtype=torch.float64)


@pytest.mark.parametrize("length", [0.5, 1.5, 5.0])
def test_variances(length, give):
    X = line(20)
    Y = 1.5 * ripple(X) + X.square()
    options = {"center": False, "constants": False, "physics": ripple}
    model = CKA(X, Y, **options)
    one = torch.ones(1, 1, 1, dtype=torch.float64)
    numbers = {f"{name}.kernel.lengthscale": length * one for name in ("rho", "delta")}
    numbers["noise.variance"] = 3e-11 * model.unit.square() * one
    give(model, numbers)
    Z = torch.tensor([[-0.2], [0.013], [0.31], [0.517], [0.99], [1.1]], dtype=torch.float64)
    with torch.no_grad(), mp.workdps(60):
        whole, rho, delta = variances(model, X, Z)
        assert whole.min() < 1e-8 * Y.var()
        pairs = [(model.posterior(Z), whole), (model.predict(Z), whole)]
        for found, exact in (*pairs, (model.rho(Z), rho), (model.delta(Z), delta)):
            torch.testing.assert_close(found.variance, exact, rtol=0.02, atol=0.0)
        half = give(CKA(X[::2], Y[::2], **options), numbers)
        later = half.condition_on_observations(X[1::2], Y[1::2])
        for found in (later.posterior(Z), later.predict(Z)):
            assert ((found.variance / whole).log().abs() < 1.0).all()


@pytest.mark.parametrize("kernel", [Stationary(), Stationary(MATERN12)], ids=repr)
def test_known_noise_of_zero(kernel, uniform):
    X = uniform(12, 2)
    Y = (3 * X).sin()
    model = ZeroMeanGP(X, Y, 0.0, covar_module=kernel)
    for found in (model.predict(X), model.posterior(X)):
        torch.testing.assert_close(found.mean, Y, rtol=0, atol=1e-5)
        assert (found.variance > 0).all()
        assert (found.variance < 1e-12).all()
    many = uniform(150, 2)
    model = CKA(many, (3 * many).sin() + many, 0.0, physics=lambda X: (3 * X).sin())
    Z = uniform(20, 2, seed=1)
    torch.testing.assert_close(model.predict(Z).mean, (3 * Z).sin() + Z, rtol=0, atol=1e-6)
    assert model.posterior(Z).rsample(torch.Size([3])).isfinite().all()
