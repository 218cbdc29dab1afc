"""Files that are the same, and what is no finite sum."""

import sys

import pytest
from gpytorch.kernels import PeriodicKernel, RFFKernel, ScaleKernel

from gpadjust import AR1, CKA, CalibratedPhysics, FunctionPhysics, Unknown, fit
from gpadjust.dynamics import LearnedDynamics
from gpadjust.export import c_source, casadi_function
from gpadjust.states import StateSpec
from tests.export.apart import apart
from tests.export.conftest import MODELS, X, Y, fitted, scaled
from tests.systems import crude


def periodic(d, batch):
    return PeriodicKernel(batch_shape=batch)


def features(d, batch):
    kernel = RFFKernel(4, ard_num_dims=d, batch_shape=batch)
    kernel._init_weights(d, 4)
    return ScaleKernel(kernel, batch_shape=batch)


def with_samples_of_parameters():
    model = MODELS["CKA, unknown parameter"]()
    fit(model, num_samples=2)
    return model


PHYSICS = FunctionPhysics(scaled, unknowns={"factor": Unknown(1.0, sd=0.5)})
REFUSED = [
    (lambda: CKA(X.repeat(2, 1, 1), Y.repeat(2, 1, 1), physics=crude), "data sets"),
    (lambda: CKA(X, Y, physics=crude, outcome_transform="log"), "with a link"),
    (lambda: CKA(X, Y, physics=crude, delta_covar_module=periodic), "PeriodicKernel"),
    (lambda: CKA(X, Y, physics=crude, delta_covar_module=features), "kernel of 'delta'"),
    (lambda: CKA(X.round(), Y, physics=crude, categorical=[0]), "CategoricalInput|GroupedRBF"),
    (with_samples_of_parameters, "method='map'"),
    (lambda: CalibratedPhysics(X, Y, physics=PHYSICS), "physics_parameters"),
    (lambda: AR1(X[:10], Y[:10], low_X=X, low_Y=Y), "AR1"),
    (lambda: CKA(X, Y, 0.1 * Y, physics=crude), "add the variance"),
    (lambda: CKA(X, Y, physics=crude, likelihood="relative"), "add the variance"),
]


@pytest.mark.slow
def test_what_is_no_finite_sum_is_refused_with_the_way_out():
    for make, words in REFUSED:
        model = make()
        for export in (c_source, casadi_function):
            with pytest.raises(ValueError, match=words):
                export(model, "f", observation_noise=True)


def test_what_is_no_model_of_terms_is_refused():
    for wrong in (None, lambda X: X):
        with pytest.raises(TypeError, match="or LearnedDynamics of one, got"):
            c_source(wrong, "f")
    with pytest.raises(RuntimeError, match="has not learnt"):
        c_source(LearnedDynamics(StateSpec(["x"], ["u"]), lambda X: X[:, :1]), "f")


def test_a_name_that_c_has_not_is_refused():
    for name in ("", "a b", "2f", "pumpe_ä", None):
        with pytest.raises(ValueError, match="one of C"):
            c_source(fitted("CKA"), name)


def test_the_same_model_makes_the_same_file():
    once, again = (c_source(CKA(X, Y, physics=crude), "f") for _ in range(2))
    assert once == again


def test_a_file_without_variance_is_small():
    model = fitted("CKA")
    whole, mean = c_source(model, "f"), c_source(model, "f", variance=False)
    assert "variance" not in mean.split("*/")[-1]
    assert len(mean) < len(whole) / 3


@apart
def test_a_physics_that_returns_another_number_of_values_is_refused():
    with pytest.raises(ValueError, match="column of 2 values"):
        casadi_function(fitted("CKA"), physics=lambda x: x[0])


def test_without_casadi_there_is_a_way_out(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(ImportError, match=r"gpadjust\[export\]"):
        casadi_function(fitted("CKA"))
