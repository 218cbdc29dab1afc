"""Files that are the same, and what is no finite sum."""

import sys

import pytest
import torch
from botorch.models.transforms.input import Warp
from gpytorch.kernels import MaternKernel

from gpadjust import CKA, CalibratedPhysics
from gpadjust.core import Fourier
from gpadjust.dynamics import LearnedDynamics
from gpadjust.export import c_source, casadi_function
from gpadjust.kinds.links import LinkedCKA
from gpadjust.kinds.relative import RelativeNoise
from gpadjust.states import StateSpec
from tests.export.apart import apart
from tests.export.conftest import LAW, MODELS, X, Y, fitted
from tests.systems import crude, normal


def with_draws_of_parameters():
    model = MODELS["CKA, unknown parameter"]()
    model.set_draws(normal(2, *model.u.shape[1:]))
    return model


def fantasies():
    model = fitted("CKA")
    return model.condition_on_observations(X[:2], Y[:2].expand(3, 2, 2))


def warped():
    warp = Warp(d=2, indices=[0], bounds=torch.tensor([[0.0, 0.0], [1.0, 1.0]]).double())
    return CKA(X, Y, physics=crude, input_transform=warp)


REFUSED = [
    (fantasies, "fantasies"),
    (lambda: LinkedCKA(X, Y, physics=crude, link="log"), "outputs with a link"),
    (lambda: CKA(X, Y, physics=crude, delta_covar_module=MaternKernel()), "kernel of 'delta'"),
    (lambda: CKA(X, Y, physics=crude, delta_covar_module=Fourier(2, 4)), "Fourier kernels alone"),
    (warped, "input transform Warp"),
    (with_draws_of_parameters, r"fit\(model, 'map'\)"),
    (lambda: CalibratedPhysics(X, Y, physics=LAW), "physics_parameters"),
    (lambda: CKA(X, Y, physics=crude, noise=RelativeNoise()), "add the variance"),
]


def test_what_is_no_finite_sum_is_refused_with_the_way_out():
    for make, words in REFUSED:
        with pytest.raises(ValueError, match=words):
            c_source(make(), "f", observation_noise=True)


def test_what_is_no_model_of_terms_is_refused():
    for wrong in (None, lambda X: X):
        with pytest.raises(TypeError, match="or what identify returns; found"):
            c_source(wrong, "f")
    with pytest.raises(RuntimeError, match="has not learnt"):
        c_source(LearnedDynamics(StateSpec(["x"], ["u"]), lambda X: X[:, :1]), "f")


def test_a_name_that_c_has_not_is_refused():
    for name in ("", "a b", "2f", "pumpe_ä", None):
        for export in (c_source, casadi_function):
            with pytest.raises(ValueError, match="one of C"):
                export(fitted("CKA"), name)


def test_the_same_model_makes_the_same_file():
    once, again = (c_source(CKA(X, Y, physics=crude), "f") for _ in range(2))
    assert once == again


def test_a_file_without_variance_is_small():
    model = fitted("CKA")
    whole, mean = c_source(model, "f"), c_source(model, "f", variance=False)
    assert "variance" not in mean.split("*/")[-1]
    assert len(mean) < len(whole) / 2


@pytest.mark.slow
@apart
def test_a_physics_that_returns_another_number_of_values_is_refused():
    with pytest.raises(ValueError, match="column of 2 values"):
        casadi_function(fitted("CKA"), physics=lambda x: x[0])


def test_without_casadi_there_is_a_way_out(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ImportError, match=r"gpadjust\[export\]"):
        casadi_function(fitted("CKA"))
