"""AR1 as joint co-kriging of two levels."""

from itertools import product

import pytest
import torch
from botorch.models.transforms import Normalize
from gpytorch.kernels import MaternKernel, ScaleKernel

from gpadjust.core import MATERN52, Stationary
from gpadjust.core.data import unit_of
from gpadjust.kinds.ar1 import AR1
from gpadjust.physics import FunctionPhysics, Unknown
from tests.systems import crude, drawn, refused, uniform

X, LOW_X, Z = (uniform(n, 2, high=2.0, seed=n) for n in (7, 11, 5))
LOW_Y = crude(LOW_X)
Y = 1.7 * crude(X) + X.sum(-1, keepdim=True).sin()
BOUNDS = torch.tensor([[-3.0, 1.0], [-2.0, 5.0]], dtype=torch.float64)
UNKNOWN = FunctionPhysics(lambda X, p: crude(X), unknowns={"w": Unknown(1.0, sd=1.0)})


class Dense:
    """The joint Gaussian of both levels in plain linear algebra, of an output at a draw."""

    def __init__(self, model, s, j, noise=None):
        values = {name: v[s, j].detach() for name, v in model.values.items()}
        unit, low_Y = model.unit[j].item(), model.low.Y
        low_unit = unit_of(low_Y, torch.zeros_like(low_Y))[j].item()
        self.rho = values["low.kernel.rho"] * unit / low_unit

        def kernel(name, unit):
            own = {k.removeprefix(f"{name}.kernel."): v for k, v in values.items()}

            def k(A, B):
                away = (A[:, None] - B[None]) / own["lengthscale"]
                e = (-0.5 * away.square().sum(-1)).exp()
                return unit**2 * (own["outputscale"] * e + own["constant"])

            return k

        self.k1, self.k2 = kernel("low", low_unit), kernel("delta", unit)
        low = 1e-6 if noise is not None else values["noise.low"] + 1e-11
        high = noise if noise is not None else (values["noise.high"] + 1e-11) * unit**2
        self.high_noise = high * torch.ones(len(model.data.X)).double()
        self.noise = torch.cat([low * low_unit**2 * torch.ones(11).double(), self.high_noise])
        self.y = torch.cat([LOW_Y[:, j], model.data.Y[:, j]])
        self.X = model.data.X

    def covariance(self, A, B):
        """Of levels 0 and then 1, given as pairs of inputs."""
        (a0, a1), (b0, b1) = A, B
        rho = self.rho
        high = rho**2 * self.k1(a1, b1) + self.k2(a1, b1)
        upper = torch.cat([self.k1(a0, b0), rho * self.k1(a0, b1)], 1)
        return torch.cat([upper, torch.cat([rho * self.k1(a1, b0), high], 1)])

    def posterior(self, Z, rows=slice(None)):
        data, at = (LOW_X, self.X), (LOW_X[:0], Z)
        K = self.covariance(data, data) + self.noise.diag()
        K, y = K[rows][:, rows], self.y[rows]
        cross = self.covariance(at, data)[:, rows]
        mean = cross @ torch.linalg.solve(K, y)
        return mean, self.covariance(at, at) - cross @ torch.linalg.solve(K, cross.mT)

    def log_likelihood(self):
        data = (LOW_X, self.X)
        K = self.covariance(data, data) + self.noise.diag()
        return torch.distributions.MultivariateNormal(torch.zeros(len(K)).double(), K).log_prob(
            self.y
        )


@pytest.mark.parametrize("Yvar", [None, 0.02])
def test_joint_co_kriging(Yvar, close):
    model = drawn(AR1(X, Y, Yvar, low_X=LOW_X, low_Y=LOW_Y))
    means, K = model.posterior(Z).gaussians
    noisy, left_out = model.marginals(Z, observation_noise=True), model.left_out()
    assert left_out.means.shape == (2, 7, 2)
    ratio = model.log_likelihood(model.u.detach())[0]
    expected = torch.zeros_like(ratio)
    for s, j in product(range(2), repeat=2):
        part = Dense(model, s, j, Yvar)
        mean, covariance = part.posterior(Z)
        close(means[s, j], mean, 1e-6)
        close(K[s, j], covariance, 1e-6)
        close(noisy.variances[s, :, j], covariance.diagonal() + part.high_noise[0], 1e-6)
        rows = torch.arange(18) != 13  # without the third observation of the high level
        mean, covariance = part.posterior(X[[2]], rows)
        close(left_out.means[s, 2, [j]], mean, 1e-6)
        close(left_out.variances[s, 2, [j]], covariance[0] + part.high_noise[2], 1e-6)
        expected[s, j] = part.log_likelihood()
    close(ratio[1] - ratio[0], expected[1] - expected[0], 1e-6)  # but for the units
    for ours, at in zip(left_out, model.left_out_at(model.u.detach()), strict=True):
        close(ours, at)
    more = model.condition_on_observations(Z, crude(Z), None if Yvar is None else 0.02 + 0 * Z)
    assert more.left_out().means.shape[-2] == 12  # of the high level


def test_low_values_may_be_missing_or_the_physics():
    given = AR1(X, Y, low_X=LOW_X, low_Y=LOW_Y).eval()
    computed = AR1(X, Y, low_X=LOW_X, physics=crude).eval()
    torch.testing.assert_close(given.predict(Z).mean, computed.predict(Z).mean)
    missing = LOW_Y.clone()
    missing[0, 1] = torch.nan
    two = AR1(X, Y, low_X=LOW_X, low_Y=missing)
    one = AR1(X, Y[:, 1:], low_X=LOW_X[1:], low_Y=LOW_Y[1:, 1:])
    torch.testing.assert_close(two.targets()[1, 1:], one.targets()[0])
    kernel = {"low_covar_module": Stationary(MATERN52), "input_transform": Normalize(2)}
    assert drawn(AR1(X, Y, low_X=LOW_X, low_Y=LOW_Y, **kernel)).predict(Z).mean.isfinite().all()


def test_samples_lie_within_the_bounds_and_the_seed_makes_them():
    rows = []

    def physics(X):
        rows.append(X)
        return crude(X)

    low = [AR1(X, Y, physics=physics, bounds=BOUNDS, num_low=33, seed=s).low.X for s in (1, 1, 2)]
    assert torch.equal(low[0], low[1])
    assert not torch.equal(low[0], low[2])
    assert len(low[0]) == 33 == len(rows[0])
    assert ((low[0] >= BOUNDS[0]) & (low[0] <= BOUNDS[1])).all()
    assert (low[0].amax(0) - low[0].amin(0) > 0.8 * (BOUNDS[1] - BOUNDS[0])).all()


def test_units_of_both_levels():
    plain = drawn(AR1(X, Y, low_X=LOW_X, low_Y=LOW_Y))
    model = drawn(AR1(X, 1e6 * Y, low_X=LOW_X, low_Y=1e-6 * LOW_Y))
    torch.testing.assert_close(model.predict(Z).mean / 1e6, plain.predict(Z).mean)


def test_a_summary_has_names_and_units_of_the_kernels():
    kernel = ScaleKernel(MaternKernel())
    options = {"low_covar_module": kernel, "delta_covar_module": kernel}
    model = AR1(X, Y[:, :1], low_X=LOW_X, low_Y=LOW_Y[:, :1], **options)
    low, delta = model.summary().split("  delta: ")
    sizes = {name: value.sqrt().item() for name, value in model.values.items()}
    assert (
        f"standard deviation over that of low_Y: {sizes['low.kernel.raw_outputscale']:.3g}" in low
    )
    assert "base_kernel.lengthscale" in low
    for name, part in (("standard deviation", "raw_outputscale"),
                       ("standard deviation of the constant", "constant")):  # fmt: skip
        size = sizes[f"delta.kernel.{part}"] * model.unit.item()
        assert f"    {name}: {size:.3g}\n" in delta


@pytest.mark.parametrize(("options", "words"), [
    ({"physics": crude}, "bounds"),
    ({"low_Y": LOW_Y}, "low_X"),
    ({"physics": crude, "bounds": BOUNDS.flip(0)}, "below"),
    ({"low_X": LOW_X, "low_Y": LOW_Y[:, :1]}, "2 inputs and 2 outputs"),
    ({"low_X": LOW_X, "physics": UNKNOWN}, "CKA"),
])  # fmt: skip
def test_bad_input(options, words):
    refused(ValueError, words, AR1, X, Y, **options)


def test_recursive_co_kriging_on_nested_designs_without_noise(close):
    """The recursion of Le Gratiet and Garnier (2014) is the joint model then."""
    model = AR1(LOW_X[:6], 1.7 * LOW_Y[:6] + LOW_X[:6].sin(), 1e-12, low_X=LOW_X, low_Y=LOW_Y)
    values = {row.name: 0.0 for row in model.table.own}
    values |= {f"{name}.kernel.lengthscale": -1.0 for name in ("low", "delta")}  # 0.5
    u = torch.cat([torch.full_like(r.location, values[r.name]) for r in model.table.own], -1)
    model.set_draws(u.reshape(model.u.shape))
    part = Dense(model.eval(), 0, 0, 1e-12)
    k1, k2, rho, y1, x2 = part.k1, part.k2, part.rho, LOW_Y[:, 0], LOW_X[:6]
    exact = part.noise[:11].diag()
    first = k1(Z, LOW_X) @ torch.linalg.solve(k1(LOW_X, LOW_X) + exact, y1)
    bias = k2(Z, x2) @ torch.linalg.solve(k2(x2, x2), model.data.Y[:, 0] - rho * y1[:6])
    close(model.predict(Z).mean[:, 0], rho * first + bias, 1e-4)
