"""Variances where there is (next to) no noise, against arithmetic with 60 digits."""

import mpmath as mp
import pytest
import torch

from gpadjust import CKA, RRA
from gpadjust.gp.gaussian import nugget
from tests.systems import line, ripple


def covariance(kernel, A, B):
    """The kernel of a term between two lists of inputs, and with itself where A is B."""
    base, scale = kernel.base_kernel, mp.mpf(kernel.outputscale.item())
    length = mp.mpf(base.lengthscale.item())
    if not hasattr(base, "randn_weights"):
        return mp.matrix([[scale * mp.exp(-(((a - b) / length) ** 2) / 2) for b in B] for a in A])
    w = [mp.mpf(v) / length for v in base.randn_weights.flatten().tolist()]
    return mp.matrix([[scale / len(w) * sum(mp.cos(v * (a - b)) for v in w) for b in B] for a in A])


def variances(model, X, Z):
    """Exact posterior variances of f, rho and delta at Z, in the user's units."""
    exact = [[mp.mpf(v) for v in values.flatten().tolist()] for values in (X, Z)]
    x, z = exact
    scale, n = mp.mpf(model.outcome_transform.stdvs.item()), len(x)
    f, g = (mp.diag([mp.mpf(v) / scale for v in ripple(P).flatten().tolist()]) for P in (X, Z))
    rho, delta = (term.kernel for term in model.terms)
    K = f * covariance(rho, x, x) * f + covariance(delta, x, x)
    K += mp.mpf(model.likelihood.noise.item()) * mp.eye(n)
    if type(model) is CKA:
        K += mp.mpf(nugget(n)) * mp.diag([K[i, i] for i in range(n)])
    inverse = mp.inverse(K)
    with_rho, with_delta = covariance(rho, z, x) * f, covariance(delta, z, x)
    k_rho, k_delta = covariance(rho, z, z), covariance(delta, z, z)
    for prior, cross, unit in (
        (g * k_rho * g + k_delta, g * with_rho + with_delta, scale**2),
        (k_rho, with_rho, 1),
        (k_delta, with_delta, scale**2),
    ):
        left = prior - cross * inverse * cross.T
        yield torch.tensor([float(left[i, i] * unit) for i in range(len(z))], dtype=torch.float64)


@pytest.mark.parametrize("length", [0.5, 1.5, 5.0])
@pytest.mark.parametrize("n", [8, 20, pytest.param(40, marks=pytest.mark.slow)])
@pytest.mark.parametrize("cls", [CKA, RRA])
def test_variances(cls, n, length):
    X = line(n)
    Y = 1.5 * ripple(X) + X.square()
    options = {"center": 0.0} | ({"num_features": 40} if cls is RRA else {})
    model = cls(X, Y, physics=ripple, **options).eval()
    noise = model.likelihood.noise_covar
    with torch.no_grad():
        noise.raw_noise.fill_(1.0001 * noise.raw_noise_constraint.lower_bound.log())
        for term in model.terms:
            term.kernel.base_kernel.lengthscale = length
    Z = torch.tensor([[-0.2], [0.013], [0.31], [0.517], [0.99], [1.1]], dtype=torch.float64)
    with torch.no_grad(), mp.workdps(60):
        whole, rho, delta = variances(model, X, Z)
        assert whole.min() < 1e-8 * Y.var()
        for posterior, exact in (
            (model.posterior(Z), whole),
            (model.predict(Z), whole),
            (model.rho(Z), rho),
            (model.delta(Z), delta),
        ):
            torch.testing.assert_close(posterior.variance.squeeze(-1), exact, rtol=0.02, atol=0.0)
        # Half of the data come later; the nugget of the first half is another one.
        half = cls(X[::2], Y[::2], physics=ripple, **options)
        half.load_state_dict(model.state_dict())
        later = half.eval().condition_on_observations(X[1::2], Y[1::2])
        ratio = later.posterior(Z).variance.squeeze(-1) / whole
        assert (ratio.log().abs() < (0.02 if cls is RRA else 1.0)).all()
