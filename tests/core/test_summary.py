"""The text of a summary."""

import re

import pytest
import torch
from botorch.models.transforms import Normalize
from gpytorch.kernels import PeriodicKernel, RBFKernel, ScaleKernel

from gpadjust.core import CKA, GP, KnownNoise, LogNormal, Noise, Stationary, Term, ZeroMeanGP
from gpadjust.physics import FunctionPhysics, Unknown

X = torch.linspace(0, 2, 7, dtype=torch.float64).unsqueeze(-1) * torch.tensor([1.0, -2.0])
Y = 50 * torch.cat([X[:, :1].sin(), X[:, 1:].cos()], -1)


def physics(X):
    return 40 * torch.cat([X[:, :1].sin(), X[:, 1:].cos()], -1)


def lines(model):
    """Return the numbers after each text, of which those of the last output count."""
    found = [line.strip().partition(": ") for line in model.summary().splitlines()]
    return {text: re.sub(r" +", " ", number) for text, _, number in found}


def three(value):
    return f"{value.item():.3g}"


def test_of_one_draw_in_the_units_of_the_user():
    model = CKA(X, Y[:, :1], physics=lambda X: physics(X)[:, :1], delta_mean=2.0)
    model.data = model.data._replace(input_names=("time [s]", "force [N]"))
    u = torch.linspace(-1, 1, model.table.size, dtype=torch.float64)
    model.set_draws(model.table.with_choice(u.reshape(1, 1, -1), 0))
    text, values, unit = model.summary(), model.values, float(model.unit)
    rho, delta = text.index("  rho: prior mean 1\n"), text.index("  delta: prior mean 2\n")
    for place, name, size in ((rho, "rho", 1.0), (delta, "delta", unit)):
        own = text[place:].splitlines()[1:5]
        length = values[f"{name}.kernel.lengthscale"][0, 0]
        assert own[0] == f"    lengthscale of time [s]: {three(length[0])}"
        assert own[1] == f"    lengthscale of force [N]: {three(length[1])}"
        sd = values[f"{name}.kernel.outputscale"].sqrt() * size
        assert own[2] == f"    standard deviation: {three(sd)}"
        sd = values[f"{name}.constant"].sqrt() * size
        assert own[3] == f"    standard deviation of the constant: {three(sd)}"
    center = model.term_sum.center(model.terms[0], values) * unit
    assert f"    center: {three(center)}\n" in text
    noise = values["noise.variance"].sqrt() * unit
    assert text.splitlines()[-1] == f"  noise: standard deviation {three(noise)}"
    assert text.splitlines()[:2] == ["CKA: 7 points, 2 inputs, 1 output, 1 draw", "y:"]
    assert "not fitted" in CKA(X, Y, physics=physics).summary()


def test_of_draws_that_contain_the_process():
    model = CKA(X, Y, physics=physics)
    u = torch.randn(8, 2, model.table.size, generator=torch.Generator().manual_seed(0)).double()
    parts = [model.table.with_choice(u[i::4], k) for i, k in ((0, 0), (1, 0), (2, 1), (3, 2))]
    model.set_draws(torch.cat(parts), number=2)  # of which predictions average over two
    assert ", 8 draws\n" in model.summary().replace(", not fitted", "")
    assert ", 8 draws)" in repr(model)
    model.set_draws(torch.cat(parts))
    text = model.summary()
    expected = (
        "  probabilities: your formula corrected 50%, as it is up to a factor and an offset 25%, "
        "of no use 25%\n"
    )
    assert text.count(expected) == 2
    assert text.count("  rho: prior mean 1, varies in 4 of 8 draws\n") == 2
    assert text.count("  delta: prior mean 0, varies in 6 of 8 draws\n") == 2
    values, numbers = model.values, lines(model)
    delta = values["delta.kernel.outputscale"][[0, 1, 2, 3, 6, 7], 1].sqrt() * model.unit[1]
    low, middle, high = delta.quantile(torch.tensor([0.025, 0.5, 0.975]).double()).tolist()
    assert numbers["standard deviation"] == f"{middle:.3g} ({low:.3g} to {high:.3g})"
    constant = values["rho.constant"][:6, 0].sqrt()  # not in the model without physics
    middle = constant.quantile(0.5)
    assert f"standard deviation of the constant: {three(middle)} (" in text
    model.set_draws(parts[2])
    assert "rho: prior mean 1, varies in 0 of 2 draws\n    standard deviation of" in model.summary()


def test_of_physics_kernels_and_transforms():
    own = FunctionPhysics(
        lambda X, p: p.g[:, None] * physics(X), unknowns={"g": Unknown(1.0, sd=0.2, unit="m/s²")}
    )
    kernel = ScaleKernel(RBFKernel()) + PeriodicKernel()
    options = {"delta_covar_module": kernel, "input_transform": Normalize(2), "nested": False}
    model = CKA(X, Y, physics=own, **options)
    model.set_draws(torch.randn(5, *model.u.shape[1:]).double())
    numbers = lines(model)
    for line in repr(model.physics_parameters).splitlines():
        assert f"\n  {line}\n" in model.summary()
    sd = (
        model.values["delta.kernel.kernels.0.raw_outputscale"][:, 1].sqrt() * model.unit[1]
    ).median()
    assert numbers["kernels.0.standard deviation"].startswith(three(sd))
    period = model.values["delta.kernel.kernels.1.raw_period_length"][:, 1].median()
    assert numbers["kernels.1.period_length"].startswith(three(period))
    assert "kernels.0.base_kernel.lengthscale after the transform" in numbers
    assert "lengthscale of x2 after the transform" in numbers


class Relative(Noise):
    """Noise with a share of f_p."""

    def __init__(self):
        super().__init__(("relative",), [LogNormal(0.01, 10.0)])

    def shares(self, places):
        return places.f[0].square().unsqueeze(-1)


@pytest.mark.parametrize("fantasies", [False, True])
def test_of_noise(fantasies):
    terms = [Term("f", Stationary()), Term("g", physics=0, mean=1.0)]
    model = GP(X, Y, terms=terms, physics=[physics], noise=Relative())
    model.set_draws(torch.zeros(3, *model.u.shape[1:]).double())
    sd = 0.1 * physics(X)[:, 1].abs()
    expected = (
        f"standard deviation {three(sd.square().mean().sqrt())}, from {three(sd.min())} to "
        f"{three(sd.max())} at the training inputs"
    )
    assert lines(model)["noise"] == expected
    known = GP(X, Y, torch.tensor([4.0, 9.0]).double(), terms=terms, physics=[physics])
    if fantasies:
        known = known.condition_on_observations(X[:2].expand(3, 2, 2) + 0.1, Y[:2])
    assert isinstance(known.noise, KnownNoise)
    assert lines(known)["noise"] == "standard deviation 3"
    assert lines(known)["g"] == "prior mean 1"


def test_without_constants():
    text = ZeroMeanGP(X[:, :1], Y, constants=False).summary()
    assert "constant" not in text
    assert "    lengthscale of x: 2\n" in text
    assert "probabilities" not in text
