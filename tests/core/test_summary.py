"""The text of a summary, and the table of priors."""

import re

import gpytorch
import pytest
import torch
from botorch.models.transforms import Normalize
from gpytorch.kernels import PeriodicKernel, RBFKernel, ScaleKernel
from gpytorch.priors import LogNormalPrior

from gpadjust import core
from gpadjust.core import CKA, GP, LogNormal, Noise, Stationary, Term, ZeroMeanGP
from gpadjust.physics import FunctionPhysics, Unknown
from tests.core.noises import Relative
from tests.systems import line, wave

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
        time, force = values[f"{name}.kernel.lengthscale"][0, 0]
        sds = [
            values[f"{name}.{part}"].sqrt() * size for part in ("kernel.outputscale", "constant")
        ]
        assert text[place:].splitlines()[1:5] == [
            f"    lengthscale of time [s]: {three(time)}",
            f"    lengthscale of force [N]: {three(force)}",
            f"    standard deviation: {three(sds[0])}",
            f"    standard deviation of the constant: {three(sds[1])}",
        ]
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
    shares = "your formula corrected 50%, as it is up to a factor and an offset 25%, of no use 25%"
    assert text.count(f"  probabilities: {shares}\n") == 2
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
    unknowns = {"g": Unknown(1.0, sd=0.2, unit="m/s²")}
    own = FunctionPhysics(lambda X, p: p.g[:, None] * physics(X), unknowns=unknowns)
    kernel = ScaleKernel(RBFKernel()) + PeriodicKernel()
    options = {"delta_covar_module": kernel, "input_transform": Normalize(2), "nested": False}
    model = CKA(X, Y, physics=own, **options)
    model.set_draws(torch.randn(5, *model.u.shape[1:]).double())
    numbers = lines(model)
    for row in repr(model.physics_parameters).splitlines():
        assert f"\n  {row}\n" in model.summary()
    variance = model.values["delta.kernel.kernels.0.raw_outputscale"][:, 1]
    sd = (variance.sqrt() * model.unit[1]).median()
    assert numbers["kernels.0.standard deviation"].startswith(three(sd))
    period = model.values["delta.kernel.kernels.1.raw_period_length"][:, 1].median()
    assert numbers["kernels.1.period_length"].startswith(three(period))
    assert "kernels.0.base_kernel.lengthscale after the transform" in numbers
    assert "lengthscale of x2 after the transform" in numbers


class OfPhysics(Relative):
    """Noise that is a share of f_p alone."""

    def __init__(self):
        Noise.__init__(self, ("relative",), [LogNormal(0.01, 10.0)])

    def shares(self, places):
        return super().shares(places)[..., 1:]


@pytest.mark.parametrize("fantasies", [False, True])
def test_of_noise(fantasies):
    terms = [Term("f", Stationary()), Term("g", physics=0, mean=1.0)]
    model = GP(X, Y, terms=terms, physics=[physics], noise=OfPhysics())
    sd = 0.1 * physics(X)[:, 1].abs()
    ends = f"from {three(sd.min())} to {three(sd.max())} at the training inputs"
    expected = f"standard deviation {three(sd.square().mean().sqrt())}, {ends}"
    assert lines(model)["noise"] == expected
    known = GP(X, Y, torch.tensor([4.0, 9.0]).double(), terms=terms, physics=[physics])
    if fantasies:
        known = known.condition_on_observations(X[:2].expand(3, 2, 2) + 0.1, Y[:2])
    assert lines(known)["noise"] == "standard deviation 3"
    assert lines(known)["g"] == "prior mean 1"


def table(model):
    return model.priors().set_index("name")


def of_waves(**options):
    X = 5 * line(9)
    return CKA(X, 20 * wave(X) + 3 * X, physics=wave, **options)


def test_priors_are_in_the_users_units_and_stay_after_a_fit():
    one = of_waves()
    rows = table(one)
    assert rows.loc["delta lengthscale of x", "median"] == pytest.approx(5.0)
    unit = float(one.unit)
    assert rows.loc["noise standard deviation", "median"] == pytest.approx(0.01 * unit)
    upper = unit * (0.1 * 1000**1.96) ** 0.5
    assert rows.loc["delta standard deviation", "97.5 %"] == pytest.approx(upper, rel=1e-3)
    core.fit(one)
    assert one.priors().equals(of_waves().priors())


RHO = Stationary(outputscale=LogNormal(0.04, 2.0))
SHORT = Stationary(lengthscale=LogNormal(0.5, 2.0))


@pytest.mark.parametrize(("options", "name", "median"), [
    ({"constants": {"rho": LogNormal(0.25, 2.0)}}, "rho standard deviation of the constant", 0.5),
    ({"rho_covar_module": RHO}, "rho standard deviation", 0.2),
    ({"rho_covar_module": SHORT}, "rho lengthscale of x", 2.5),
    ({"delta_covar_module": SHORT}, "delta lengthscale of x", 2.5),
])  # fmt: skip
def test_each_prior_is_replaced_by_one_argument(options, name, median, tmp_path):
    changed, usual = table(of_waves(**options)), table(of_waves())
    assert changed.loc[name, "median"] == pytest.approx(median)
    others = changed.index != name
    assert changed.loc[others].equals(usual.loc[others])
    saved = core.save(one := of_waves(**options), tmp_path / "model.pt")
    given = {name: options[name] for name in saved.missing}  # kernels of one's own
    again = core.load(tmp_path / "model.pt", physics=wave, **given)
    assert again.priors().equals(one.priors())


def test_noise_unknowns_and_priors_of_gpytorch():
    one = of_waves(noise=Noise(priors=[LogNormal(0.04, 2.0)]))
    found = table(one).loc["noise standard deviation", "median"]
    assert found == pytest.approx(0.2 * float(one.unit))
    unknowns = {"k": Unknown(3.0, sd=1.0, unit="N/m")}
    physics = FunctionPhysics(lambda X, p: p.k * X[:, 0], unknowns=unknowns)
    X = line(6)
    row = table(CKA(X, X, physics=physics)).loc["k"]
    assert row["2.5 %"] == pytest.approx(3 - 1.96, abs=1e-2)
    assert "N/m" in row["meaning"]
    kernel = gpytorch.kernels.RBFKernel(lengthscale_prior=LogNormalPrior(1.0, 0.1))
    row = table(ZeroMeanGP(X, X, covar_module=kernel)).filter(like="lengthscale", axis=0)
    assert row["median"].item() == pytest.approx(torch.e, rel=0.05)
