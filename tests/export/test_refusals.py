"""Files that are the same, and what is no finite sum."""

import sys

import pytest
import torch
from botorch.models.transforms.input import Warp
from gpytorch.kernels import MaternKernel

from gpadjust import CKA, CalibratedPhysics, Unknown
from gpadjust.core import Fourier
from gpadjust.dynamics import LearnedDynamics
from gpadjust.export import c_source, casadi_function
from gpadjust.kinds.links import LinkedCKA
from gpadjust.kinds.relative import RelativeNoise
from gpadjust.physics import BlackBoxPhysics, FormulaPhysics, FunctionPhysics, ODEPhysics
from gpadjust.states import StateSpec
from tests.export.apart import apart
from tests.export.conftest import LAW, MODELS, X, Y, fitted
from tests.export.test_equations import PHYSICS, SPRING, learnt
from tests.systems import crude, normal, refused


def with_draws_of_parameters():
    model = MODELS["CKA, unknown parameter"]()
    model.set_draws(normal(2, *model.u.shape[1:]))
    return model


def fantasies():
    model = fitted("CKA")
    return model.condition_on_observations(X[:2], Y[:2].expand(3, 2, 2))


def warped():
    warp = Warp(d=2, indices=[0], bounds=torch.tensor([[0.0, 0.0], [1.0, 1.0]]).double())
    return CKA(X, Y, physics=crude, input_transform=warp.requires_grad_(False))


def unlearnt():
    return LearnedDynamics(StateSpec(["x"], ["u"]), lambda X: X[:, :1])


CUT = {"a": Unknown(1.0, sd=1.0, bounds=(0.0, 2.0), function_of="x", between=(0.0, 1.0))}
FREE, NOISY = {"parameters": True}, {"observation_noise": True}
REFUSED = [
    (fantasies, {}, ValueError, "fantasies"),
    (lambda: LinkedCKA(X, Y, physics=crude, link="log"), {}, ValueError, "outputs with a link"),
    (
        lambda: CKA(X, Y, physics=crude, delta_covar_module=MaternKernel()),
        *({}, ValueError, "kernel of 'delta'"),
    ),
    (
        lambda: CKA(X, Y, physics=crude, delta_covar_module=Fourier(2, 4)),
        *({}, ValueError, "Fourier kernels alone"),
    ),
    (warped, {}, ValueError, "input transform Warp"),
    (with_draws_of_parameters, {}, ValueError, r"fit\(model, 'map'\)"),
    (lambda: CalibratedPhysics(X, Y, physics=LAW), {}, ValueError, "physics_parameters"),
    (
        lambda: CKA(X, Y, physics=crude, noise=RelativeNoise()),
        *(NOISY, ValueError, "add the variance"),
    ),
    (lambda: learnt()[1], FREE, ValueError, "fitted with these values.*: leave it out"),
    (unlearnt, {}, RuntimeError, "has not learnt"),
    *((lambda wrong=w: wrong, {}, TypeError, "or what identify returns; f") for w in (None, 3, X)),
    (lambda: FunctionPhysics(crude), {}, TypeError, "'crude', a FunctionPhysics: expected equa"),
    (lambda: BlackBoxPhysics(crude), {}, TypeError, "BlackBoxPhysics: expected equations"),
    (lambda: ODEPhysics(crude, 0.1, 1), {}, TypeError, "ODEPhysics: expected equations"),
    (lambda: ODEPhysics(SPRING, 0.1, 2, inputs=[0, 1, -1]), {}, ValueError, "from the end"),
    (
        lambda: FormulaPhysics("a * x", ["x"], unknowns=CUT),
        *({}, ValueError, "bounds cut off its prior"),
    ),
    (lambda: FormulaPhysics("x", ["x"]), FREE, ValueError, "found none. Leave it out"),
    (lambda: PHYSICS["curves"], FREE, ValueError, "found dry, drag, share"),
]


def test_what_is_refused_with_the_way_out():
    for make, options, error, words in REFUSED:
        refused(error, words, c_source, make(), "f", **options)
    words = "which have nothing else"
    refused(ValueError, words, casadi_function, PHYSICS["rk4"], physics=crude)
    for name in ("", "a b", "2f", "pumpe_ä", None):
        for export in (c_source, casadi_function):
            refused(ValueError, "one of C", export, fitted("CKA"), name)


def test_a_file_without_variance_is_small():
    model = fitted("CKA")
    whole, mean = c_source(model, "f"), c_source(model, "f", variance=False)
    assert "variance" not in mean.split("*/")[-1]
    assert len(mean) < len(whole) / 2


@pytest.mark.slow
@apart
def test_a_physics_that_returns_another_number_of_values_is_refused():
    words = "column of 2 values"
    refused(ValueError, words, casadi_function, fitted("CKA"), physics=lambda x: x[0])


def test_without_casadi_there_is_a_way_out(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    refused(ImportError, r"gpadjust\[export\]", casadi_function, fitted("CKA"))
