"""Programs of models say what the models predict."""

import doctest

import pytest
import torch

from gpadjust.export import c_source, casadi_function
from tests.export.apart import apart
from tests.export.conftest import CANCELS, MODELS, called, compiled, fitted
from tests.systems import uniform

POINTS = torch.cat([uniform(4, 2, low=-0.5, high=1.5, seed=1), uniform(1, 2), 50 * uniform(1, 2)])


def arguments(model, X):
    """What a program is given: the inputs, and f_p where there is a physics."""
    f_p = getattr(model.input_transform, "values", None) if hasattr(model, "input_transform") else 0
    return (X, f_p(X)) if f_p else (X,)


def agrees(name, found, expected):
    tolerance = 1e-7 if name in CANCELS else 1e-10
    for value, right in zip(found, expected, strict=True):
        torch.testing.assert_close(value, right, rtol=tolerance, atol=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_c_says_what_the_model_predicts(name, tmp_path):
    model = fitted(name)
    noise = not model.noise.is_known
    expected = model.predict(POINTS, observation_noise=noise)
    program = compiled(c_source(model, "f", observation_noise=noise), tmp_path)
    for *given_, mean, variance in zip(*arguments(model, POINTS), *expected, strict=True):
        sizes = (model.num_outputs,) * 2
        agrees(name, called(program.f_predict, sizes, *given_), (mean, variance))


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@apart
def test_casadi_says_what_the_model_predicts(name):
    model = fitted(name)
    function = casadi_function(model)
    for *given_, mean, variance in zip(
        *arguments(model, POINTS), *model.predict(POINTS), strict=True
    ):
        found = function(*(each.numpy() for each in given_))
        agrees(name, [torch.tensor(each.full()[:, 0]) for each in found], (mean, variance))


@apart
def test_the_example_runs():
    example = casadi_function.__doc__.replace("  # doctest: +SKIP", "")
    found = doctest.DocTestParser().get_doctest(example, {}, "example", None, 0)
    assert doctest.DocTestRunner().run(found).failed == 0


def test_the_file_says_the_parameters_of_its_physics():
    model = fitted("CKA, unknown parameter")
    value = model.physics_parameters.mean.item()
    assert f" * Its parameters are factor = {value!r}.\n" in c_source(model, "pump")
    assert "parameters" not in c_source(fitted("CKA, unknown mean"), "pump")
