"""Programs of a physics that is written in formulas."""

import functools
from types import SimpleNamespace

import pytest
import torch

from gpadjust import CKA
from gpadjust.dynamics import IdentifiedDynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.export import c_source, casadi_function
from gpadjust.physics import FormulaPhysics, ODEPhysics, PhysicsParameters, Unknown
from gpadjust.states import StateSpec
from tests.export.apart import apart
from tests.export.conftest import called, compiled, in_casadi
from tests.systems import normal, uniform

EVERYTHING = (
    "sin(x) + cos(x) * tan(x) - asin(x / 4) + acos(x / 4) / (2 + atan(v)) + atan2(v, x), "
    "sinh(x) - cosh(v) + tanh(x) * exp(-v) + log(x * x) - ln(v ** 2) + log10(abs(v)) + pi, "
    "sqrt(abs(x)) ** 3 - sign(x * v) + sign(0 * x) + max(x, v) * min(x, -v) + pow(2.5e-7, -0.1), "
    "where(x < v, x, 1 / v) + (x <= v) + 2 * (x > 0) + 3 * (x >= v) + +x + PI() * IF(v, 7, 8), 3"
)
NUMBERS = {
    "k": Unknown(2.0, factor=1.5),
    "c": Unknown(-0.1, sd=0.1),
    "unused": Unknown(1.0, sd=1.0),
}
SPRING = FormulaPhysics("v, u - k * sin(x) - c * v", ["x", "v", "u"], unknowns=NUMBERS)
OVER_V = {"function_of": "abs(v)", "between": (0.0, 2.0)}
CURVES = {
    "dry": Unknown(0.3, factor=1.5, **OVER_V),
    "drag": Unknown(-0.1, sd=0.3, **OVER_V, lengthscale=1.0),
    "share": Unknown(0.5, bounds=(0.0, 1.0), function_of="x + u", between=(-1.0, 1.0)),
}
CURVED = FormulaPhysics("v, u * share - dry * sign(v) - drag * v", ["x", "v", "u"], unknowns=CURVES)
PHYSICS = {
    "everything": FormulaPhysics(EVERYTHING, ["x", "v"]),
    "spring": SPRING,
    "rk4": ODEPhysics(SPRING, 0.1, 2, substeps=3),
    "midpoint": ODEPhysics(SPRING, 0.1, 2, substeps=2, method="midpoint"),
    "euler, columns": ODEPhysics(SPRING, 0.1, 2, method="euler", inputs=[2, 0, 1]),
    "curves": ODEPhysics(CURVED, 0.1, 2, substeps=2),
}
SPEC = StateSpec(
    ["goal", "x", "v", "last"],
    ["u"],
    angles=["x"],
    exogenous=["goal"],
    previous={"last": "u"},
    step=0.1,
)


def points(physics):
    """Points beyond the range of curves, too."""
    d = len(getattr(physics, "rhs", physics).columns)
    return uniform(6, d, low=-3.0, high=3.0)


def same(found, expected):
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


@functools.cache
def dynamics(name):
    """Dynamics with draws of the parameters, as a log would identify."""
    physics = PHYSICS[name]
    values = physics.unknowns.to_values(0.7 * normal(9, len(physics.unknowns), seed=2))
    parameters = PhysicsParameters(physics.unknowns, values.unbind(-1))
    noises = torch.full((2, 4), 0.1, dtype=torch.float64)
    return IdentifiedDynamics(SPEC, physics, parameters, *noises)


@pytest.mark.parametrize("name", PHYSICS)
@apart
def test_programs_say_what_the_physics_says(name, tmp_path):
    physics = PHYSICS[name]
    X, function = points(physics), casadi_function(physics)
    assert (function.name_in(), function.name_out()) == (["x"], ["mean"])
    program = compiled(c_source(physics, "law"), tmp_path)
    for x, y in zip(X, physics(X), strict=True):
        same(called(program.law_predict, y.shape, x), [y])
        same(in_casadi(function, x), [y])


@pytest.mark.parametrize("name", ["rk4", "curves"])
@apart
def test_programs_of_identified_dynamics_say_their_mean(name, tmp_path):
    own = dynamics(name)
    states, actions = uniform(4, 4, low=-2.0, high=2.0), uniform(4, 1, seed=1)
    program = compiled(c_source(own, "arm"), tmp_path)
    function = casadi_function(own, "step")
    for state, action, mean in zip(states, actions, own.predict(states, actions).mean, strict=True):
        same(called(program.arm_step, (4,), state, action), [mean])
        same(in_casadi(function, state, action), [mean])


@apart
def test_parameters_may_be_an_argument(tmp_path):
    own, free = dynamics("rk4"), {"parameters": True}
    state, action, values = normal(4), normal(1, seed=1), own.physics_parameters.draws[3]
    expected = own.sample_functions(9, seed=0)  # of all draws, in another order
    function = casadi_function(own, **free)
    assert function.name_in() == ["state", "action", "parameters"]
    (found,) = in_casadi(function, state, action, values)
    paths = expected(state.expand(9, 1, 4), action.expand(9, 1, 1))[:, 0]
    assert ((paths - found).abs().amax(-1) < 1e-10).sum() == 1
    program = compiled(c_source(own, "arm", **free), tmp_path)
    same(called(program.arm_step, (4,), state, action, values), [found])
    x = normal(3, seed=4)
    same(in_casadi(casadi_function(SPRING, **free), x, values), [SPRING(x[None], values)[0]])


def test_curves_may_have_the_names_of_other_functions(tmp_path):
    curves = {name: Unknown(0.3, factor=2.0, **OVER_V) for name in ("rates", "sign", "step")}
    law = FormulaPhysics("u - (rates + sign) * sign(v) - step * v", ["v", "u"], unknowns=curves)
    for name, physics in (("law", law), ("step", ODEPhysics(law, 0.1, 1))):
        x = points(physics)[0]
        program = compiled(c_source(physics, "law"), tmp_path, name)
        same(called(program.law_predict, (1,), x), [physics(x[None])[0]])


@functools.cache
def learnt():
    """Dynamics and a model whose physics is written, and what they predict."""
    unknowns = {"k": Unknown(2.0, factor=1.5)}
    rates = FormulaPhysics("v, u - k * sin(x)", ["x", "v", "u"], unknowns=unknowns)
    spec = StateSpec(["x", "v"], ["u"], angles=["x"])
    states, actions = 2 * normal(20, 2), normal(20, 1, seed=1)
    physics = ODEPhysics(rates, 0.1, 2, substeps=2)
    moved = physics(torch.cat([states, actions], -1)) - 0.02 * states
    found = LearnedDynamics(spec, physics, fit_options={"method": "map"})
    found.update(states, actions, moved + 1e-3 * normal(20, 2, seed=2))
    X = uniform(12, 1)
    line = FormulaPhysics("2 * x", ["x"])
    square = FormulaPhysics("x ** 2", ["x"])
    model = CKA(X, X.exp(), physics={"line": line, "square": square})
    return found, model


@apart
def test_a_model_has_its_written_physics_within(tmp_path):
    found, model = learnt()
    x, state, action = uniform(1, 1, seed=3), normal(1, 2, seed=3), normal(1, 1, seed=4)
    code = c_source(model, "m") + c_source(found, "d") + c_source(PHYSICS["curves"], "p")
    program = compiled(code + c_source(found, "d_mean", variance=False), tmp_path)
    predicted = found.predict(state[0], action[0]).mean
    (mean,) = called(program.d_mean_step, (2,), state[0], action[0])
    torch.testing.assert_close(mean, predicted, rtol=1e-9, atol=1e-9)
    noise = {"observation_noise": False}
    for name, own, given, options in (
        ("m_predict", model, [x], {}),
        ("d_step", found, [state, action], noise),
    ):
        mean, variance = (part[0] for part in own.predict(*given, **options))
        rows = [each[0] for each in given]
        in_c = called(getattr(program, name), 2 * (mean.numel(),), *rows)
        for values in (in_c, in_casadi(casadi_function(own), *rows)):
            torch.testing.assert_close(values[0], mean, rtol=1e-9, atol=1e-9)
            torch.testing.assert_close(values[1], variance, rtol=1e-7, atol=1e-9)


def test_of_an_identification_the_dynamics_are_exported():
    step = PhysicsDynamics(StateSpec(["x", "v"], ["u"]), PHYSICS["rk4"])
    assert c_source(SimpleNamespace(dynamics=step), "a") == c_source(step, "a")
