"""A delta that is orthogonal to what the parameters of the physics change."""

import pytest
import torch

from gpadjust.core import CKA, MATERN52, PhysicsMeanGP, Stationary
from gpadjust.kinds.categories import Categories
from gpadjust.physics import FunctionPhysics, Unknown
from paper.common.orthogonal import Orthogonal
from tests.systems import normal, refused, uniform

LAW = FunctionPhysics(
    lambda X, p: p.a * (p.w * X[:, 0]).sin(),
    unknowns={"a": Unknown(1.0, sd=2.0), "w": Unknown(3.0, factor=1.5)},
)
X = uniform(12, 2)
Y = 1.4 * (3.3 * X[:, :1]).sin() + 0.3 * X[:, 1:] + 0.05 * normal(12, 1, seed=1)


def drawn(model, number=2):
    """Hold random coordinates."""
    model.set_draws(0.4 * normal(number, *model.u.shape[1:], seed=3))
    return model.eval()


@pytest.mark.parametrize("kernel", [None, Stationary(MATERN52)])
def test_the_formula_gradient_and_features(kernel):
    """Plumlee's formula with an inverse, and exact derivatives of the law at its best."""
    delta = Orthogonal(LAW, kernel)
    model = drawn(CKA(X, Y, physics=LAW, delta_covar_module=delta, nested=False), 1)
    term, Z = model.terms[1], uniform(5, 2, seed=4)
    own, k = model.at(X).own(term), term.kernel.kernel
    a, w = 1.4, 3.3
    G = torch.stack([(w * X[:, 0]).sin(), a * X[:, 0] * (w * X[:, 0]).cos()], -1)
    exact = term.kernel.directions
    assert (G - exact @ torch.linalg.lstsq(exact, G).solution).abs().max() < 0.1
    x, z = X[None, None], Z[None, None]
    inner = torch.linalg.inv(exact.mT @ k.covariance(own, x) @ exact)
    taken = k.covariance(own, x, x) @ exact @ inner @ exact.mT @ k.covariance(own, x, z)
    torch.testing.assert_close(
        term.kernel.covariance(own, x, z), k.covariance(own, x, z) - taken, rtol=0, atol=1e-7
    )
    K = term.kernel.covariance(own, x)
    assert (exact.mT @ K).abs().max() < 1e-7
    torch.testing.assert_close(term.kernel.variance(own, x), K.diagonal(dim1=-1, dim2=-2))
    phi = term.kernel.features(own, 20000, torch.Generator().manual_seed(0))(x)
    assert (phi @ phi.mT - K).abs().max() < 0.05 * own["outputscale"].max()
    u = model.u.detach()
    _, gradient = model.log_likelihood(u)
    for i in range(u.shape[-1]):
        step = torch.zeros_like(u)
        step[..., i] = 1e-5
        high, low = (model.log_likelihood(u + sign * step)[0] for sign in (1, -1))
        torch.testing.assert_close(gradient[..., i], (high - low) / 2e-5, rtol=1e-4, atol=1e-4)


def test_categories_and_errors():
    codes = torch.cat([X, (torch.arange(12) % 2)[:, None]], -1)
    options = {"physics": LAW, "covar_module": Orthogonal(LAW)}
    model = PhysicsMeanGP(codes, Y, **options, input_transform=Categories([2]))
    assert model.terms[1].kernel.directions.shape == (12, 2)
    assert model.terms[1].constant is None
    assert model.predict(codes).mean.isfinite().all()
    two = torch.cat([Y, Y], -1)
    law = FunctionPhysics(lambda X, p: p.a * X, unknowns={"a": Unknown(1.0, sd=1.0)})
    for physics, targets, says in (
        (law, two, "one output"),
        (lambda X: X[:, 0], Y, "unknown parameters"),
    ):
        kernel = Orthogonal(physics)
        refused(ValueError, says, PhysicsMeanGP, X, targets, physics=physics, covar_module=kernel)
