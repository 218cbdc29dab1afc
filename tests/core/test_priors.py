"""The table of priors: units, and each prior replaced by one argument."""

import gpytorch
import pytest
import torch
from gpytorch.priors import LogNormalPrior

from gpadjust import CKA, FunctionPhysics, Unknown, ZeroMeanGP, fit, load, save
from gpadjust.core import LogNormal, Noise, Stationary
from tests.systems import line, wave


def table(model):
    return model.priors().set_index("name")


def model(**options):
    X = 5 * line(9)
    return CKA(X, 20 * wave(X) + 3 * X, physics=wave, **options)


def test_priors_are_in_the_users_units_and_stay_after_a_fit():
    one = model()
    rows = table(one)
    assert rows.loc["delta lengthscale of x", "median"] == pytest.approx(5.0)
    unit = float(one.unit)
    assert rows.loc["noise standard deviation", "median"] == pytest.approx(0.01 * unit)
    assert rows.loc["delta standard deviation", "97.5 %"] == pytest.approx(
        unit * (0.1 * 1000**1.96) ** 0.5, rel=1e-3
    )
    fit(one)
    assert one.priors().equals(model().priors())


@pytest.mark.parametrize(
    ("options", "name", "median"),
    [
        (
            {"constants": {"rho": LogNormal(0.25, 2.0)}},
            "rho standard deviation of the constant",
            0.5,
        ),
        (
            {"rho_covar_module": Stationary(outputscale=LogNormal(0.04, 2.0))},
            "rho standard deviation",
            0.2,
        ),
        (
            {"delta_covar_module": Stationary(lengthscale=LogNormal(0.5, 2.0))},
            "delta lengthscale of x",
            2.5,
        ),
    ],
)
def test_each_prior_is_replaced_by_one_argument(options, name, median, tmp_path):
    changed, usual = table(model(**options)), table(model())
    assert changed.loc[name, "median"] == pytest.approx(median)
    others = changed.index != name
    assert changed.loc[others].equals(usual.loc[others])
    saved = save(one := model(**options), tmp_path / "model.pt")
    given = {name: options[name] for name in saved.missing}  # kernels of one's own
    again = load(tmp_path / "model.pt", physics=wave, **given)
    assert again.priors().equals(one.priors())


def test_noise_unknowns_and_priors_of_gpytorch():
    one = model(noise=Noise(priors=[LogNormal(0.04, 2.0)]))
    found = table(one).loc["noise standard deviation", "median"]
    assert found == pytest.approx(0.2 * float(one.unit))
    physics = FunctionPhysics(
        lambda X, p: p.k * X[:, 0], unknowns={"k": Unknown(3.0, sd=1.0, unit="N/m")}
    )
    X = line(6)
    row = table(CKA(X, X, physics=physics)).loc["k"]
    assert row["2.5 %"] == pytest.approx(3 - 1.96, abs=1e-2)
    assert "N/m" in row["meaning"]
    kernel = gpytorch.kernels.RBFKernel(lengthscale_prior=LogNormalPrior(1.0, 0.1))
    row = table(ZeroMeanGP(X, X, covar_module=kernel)).filter(like="lengthscale", axis=0)
    assert row["median"].item() == pytest.approx(torch.e, rel=0.05)
