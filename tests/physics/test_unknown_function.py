"""Unknown parameters that are functions."""

import pickle

import numpy as np
import pytest
import torch

from gpadjust import CalibratedPhysics, PhysicsMeanGP, fit, load, save
from gpadjust.dynamics import PhysicsDynamics
from gpadjust.physics import (
    BlackBoxPhysics,
    FormulaPhysics,
    FunctionPhysics,
    ODEPhysics,
    PhysicsParameters,
    Unknown,
)
from gpadjust.states import StateSpec
from tests.systems import normal, refused, same, uniform

OVER = {"function_of": "abs(v)", "between": (0.0, 6.0)}
PRIORS = {
    "sd": Unknown(0.3, sd=0.2, **OVER),
    "factor": Unknown(0.3, factor=1.5, **OVER),
    "uniform": Unknown(0.3, bounds=(0.0, 1.0), **OVER),
    "cut": Unknown(0.3, sd=0.2, bounds=(0.0, 1.0), **OVER),
}
UNKNOWNS = {"friction": PRIORS["factor"], "J": Unknown(1.0, factor=2.0)}
FORMULA = FormulaPhysics("(u - friction * sign(v)) / J", ["v", "u"], unknowns=UNKNOWNS)


def by_torch(X, p):
    return (X[:, 1] - p.friction(X[:, 0].abs()) * X[:, 0].sign()) / p["J"]


def by_numpy(x, p):
    return (x[1] - p["friction"](abs(x[0])) * np.sign(x[0])) / p.J


@pytest.mark.parametrize("prior", PRIORS)
def test_at_each_point_it_has_its_prior(prior):
    """Also between the knots, and beyond their range."""
    unknowns = FunctionPhysics(by_torch, unknowns={"friction": PRIORS[prior]}).unknowns
    z = normal(4000, len(unknowns))
    draws = PhysicsParameters(unknowns, unknowns.to_values(z).unbind(-1))
    coordinates = PRIORS[prior].coordinate(draws.friction(torch.tensor([0.0, 3.3, 4.0, 50.0])))
    torch.testing.assert_close(coordinates.mean(0), torch.zeros(4).double(), atol=0.06, rtol=0)
    torch.testing.assert_close(coordinates.std(0), torch.ones(4).double(), atol=0.06, rtol=0)
    torch.testing.assert_close(
        unknowns.to_coordinates(unknowns.to_values(z)), z, rtol=1e-6, atol=1e-6
    )


def test_between_the_knots_it_is_a_gaussian_process():
    """The formula of a conditional mean, and of Matern's kernel."""
    unknown, knots = PRIORS["sd"], torch.linspace(0, 6, 13).double()
    assert unknown.lengthscale == 1.5

    def kernel(a, b):
        r = 5**0.5 * (a[:, None] - b).abs() / 1.5
        return (1 + r + r**2 / 3) * (-r).exp()

    unknowns = FunctionPhysics(by_torch, unknowns={"friction": unknown}).unknowns
    values, x = 0.3 + 0.2 * normal(13), uniform(5, 1, high=6.0)[:, 0]
    expected = 0.3 + kernel(x, knots) @ torch.linalg.solve(kernel(knots, knots), values - 0.3)
    found = PhysicsParameters(unknowns, values[None].unbind(-1)).friction(x)[0]
    covariance = unknown.root @ unknown.root.mT
    same([found, covariance], [expected, kernel(knots, knots)], rtol=1e-6, atol=1e-6)


def test_formulas_and_functions_of_torch_and_numpy_read_the_same():
    X = torch.tensor([[2.0, 1.0], [-2.5, 1.0], [20.0, 0.5]]).double()
    values = FORMULA.unknowns.to_values(normal(4, len(FORMULA.unknowns)))
    expected = FORMULA(X, values)
    for physics in (
        FunctionPhysics(by_torch, unknowns=UNKNOWNS),
        BlackBoxPhysics(by_numpy, batched=False, unknowns=UNKNOWNS),
    ):
        torch.testing.assert_close(physics(X, values), expected)
    step = ODEPhysics(FORMULA, 0.1, 1, substeps=1, method="euler")
    torch.testing.assert_close(step(X, values), X[:, :1] + 0.1 * expected)
    guess = (X[:, 1] - 0.3 * X[:, 0].sign()).unsqueeze(-1)
    torch.testing.assert_close(FORMULA(X), guess)


def test_its_slope_is_that_of_autograd():
    X = torch.tensor([[2.0, 1.0], [3.3, 1.0]]).double().requires_grad_()
    values = FORMULA.unknowns.to_values(normal(len(FORMULA.unknowns)))
    assert torch.autograd.gradcheck(lambda X: FORMULA(X, values), X)


def test_values_are_of_the_knots_in_tables_and_curves_by_name():
    unknowns = FORMULA.unknowns
    parameters = PhysicsParameters(unknowns, unknowns.to_values(normal(9, 14)).unbind(-1))
    again = pickle.loads(pickle.dumps(parameters))
    torch.testing.assert_close(again.friction(2.0)[:, 0], parameters["friction(2)"])
    near = Unknown(1.0, sd=0.1, function_of="v", between=(1e5, 1e5 + 1))
    names = [*FunctionPhysics(by_torch, unknowns={"a": near}).unknowns]
    assert len(names) == 13
    assert names[:2] == ["a(100000)", "a(100000.08)"]
    assert "friction(5.5)" in repr(parameters)
    assert "'friction': Unknown(0.3, factor=1.5, function_of='abs(v)'" in repr(FORMULA)
    with pytest.raises(AttributeError, match=r"expected one of friction\(0\), .*, J, friction\."):
        parameters.frictoin  # noqa: B018
    with pytest.raises(KeyError):
        parameters["frictoin"]
    axes = parameters.plot()
    assert [ax.get_xlabel() for ax in axes] == ["abs(v)", "J"]


def curve(v):
    return 0.2 + 0.3 * (-v / 2).exp()


def measured(number=60, seed=0):
    speed = uniform(number, 1, low=0.5, high=6.0, seed=seed)
    push = uniform(number, 1, seed=seed + 1)
    noise = 0.01 * normal(number, 1, seed=seed + 2)
    return torch.cat([speed, push], -1), (push - curve(speed)) / 0.8 + noise


def covers(parameters):
    x = torch.linspace(0.5, 6.0, 40).double()
    low, high = parameters.friction(x).quantile(torch.tensor([0.025, 0.975]).double(), dim=0)
    return ((low <= curve(x)) & (curve(x) <= high)).double().mean(), (high - low).mean()


@pytest.mark.slow
def test_a_model_finds_it(tmp_path):
    shares = []
    for seed, structure, most in (
        (0, PhysicsMeanGP, 0.3),
        (10, CalibratedPhysics, 0.05),
        (20, CalibratedPhysics, 0.05),
    ):
        X, Y = measured(seed=seed)
        model = structure(X, Y, physics=FORMULA)
        fit(model)
        share, width = covers(model.physics_parameters)
        shares.append(share)
        assert width < most
    assert sum(shares) / len(shares) >= 0.9
    assert "friction(4)" in str(model.summary())
    save(model, tmp_path / "model.pt")
    again = load(tmp_path / "model.pt")
    torch.testing.assert_close(again.predict(X[:3]).mean, model.predict(X[:3]).mean)


@pytest.mark.slow
def test_least_squares_find_it():
    step = FormulaPhysics("v + 0.1 * (u - friction * sign(v)) / J", ["v", "u"], unknowns=UNKNOWNS)
    found = []
    for seed in range(0, 15, 3):
        X, Y = measured(200, seed)
        dynamics = PhysicsDynamics(StateSpec(["v"], ["u"]), step)
        dynamics.update(X[:, :1], X[:, 1:], X[:, :1] + 0.1 * Y)
        found.append(torch.stack(covers(dynamics.physics_parameters)))
    share, width = torch.stack(found).mean(0)
    assert share >= 0.85  # errors along a curve go together
    assert width < 0.05


V = {"function_of": "v"}
REFUSED = [
    (V, "Expected of a function its variable and the range"),
    ({"between": (0.0, 1.0)}, "Expected of a function its variable and the range"),
    ({**V, "between": (1.0, 1.0)}, "the range of that"),
    ({**V, "between": (0.0, float("inf"))}, "the range of that"),
    ({**V, "between": (0, 1, 2)}, r"between as two numbers.*found \(0, 1, 2\)"),
    ({**V, "between": "01"}, "between as two numbers.*found '01'"),
    ({**OVER, "lengthscale": 0.1}, "0.05 of the range or more, found 0.1 of 6"),
    ({**OVER, "lengthscale": -1.0}, "lengthscale"),
]


def test_bad_input_is_refused_with_the_way_out():
    for options, words in REFUSED:
        refused(ValueError, words, Unknown, 0.3, sd=0.1, **options)
    refused(TypeError, "the name of a variable", Unknown, 0.3, sd=0.1, function_of=3)
    for variable in ("speed", "friction", "v +"):
        unknowns = {"friction": Unknown(0.3, sd=0.1, function_of=variable, between=(0.0, 1.0))}
        words = r"expected one of v, u|Expected a formula"
        refused(ValueError, words, FormulaPhysics, "u - friction", ["v", "u"], unknowns=unknowns)
