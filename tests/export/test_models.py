"""Programs of models say what the models predict."""

import doctest

import pytest
import torch

from gpadjust.export import c_source, casadi_function
from tests.export.apart import apart
from tests.export.conftest import MODELS, called, compiled, fitted, in_casadi
from tests.systems import uniform

POINTS = torch.cat([uniform(4, 2, low=-0.5, high=1.5, seed=1), uniform(1, 2), 50 * uniform(1, 2)])


def arguments(model, X):
    """What a program is given: the inputs, and f_p where there is a physics."""
    values = [
        each(X, *([each.unknowns.to_values(model.u[0, :, -1:])] if each.unknowns else []))
        for each in model.physics
    ]
    values = [value.detach().reshape(len(X), -1) for value in values]
    return (X, torch.cat(values, -1)) if values else (X,)


def agrees(model, found, expected):
    """To 1e-10, of a variance that is left of a larger one in units of that."""
    mean, variance = found
    torch.testing.assert_close(mean, expected[0], rtol=1e-9, atol=1e-9)
    prior = model.unit.squeeze(-1).square().max().item()
    torch.testing.assert_close(variance, expected[1], rtol=1e-10, atol=1e-10 * prior)


QUICK = ("CKA", "CKA, nested", "CKA, missing", "CKA, scaled inputs", "RRA")
CASES = [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in MODELS]


@pytest.mark.parametrize("name", CASES)
def test_c_says_what_the_model_predicts(name, tmp_path):
    model = fitted(name)
    expected = model.predict(POINTS, observation_noise=True)
    program = compiled(c_source(model, "f", observation_noise=True), tmp_path)
    for *given, mean, variance in zip(*arguments(model, POINTS), *expected, strict=True):
        sizes = (model.num_outputs,) * 2
        agrees(model, called(program.f_predict, sizes, *given), (mean, variance))


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@apart
def test_casadi_says_what_the_model_predicts(name):
    model = fitted(name)
    function = casadi_function(model)
    for *given, mean, variance in zip(
        *arguments(model, POINTS), *model.predict(POINTS), strict=True
    ):
        agrees(model, in_casadi(function, *given), (mean, variance))


@pytest.mark.slow
@apart
def test_the_example_runs():
    example = casadi_function.__doc__.replace("  # doctest: +SKIP", "")
    found = doctest.DocTestParser().get_doctest(example, {}, "example", None, 0)
    assert doctest.DocTestRunner().run(found).failed == 0


def test_the_file_says_the_parameters_of_its_physics():
    model = fitted("CKA, unknown parameter")
    value = model.physics_parameters.mean.item()
    assert f" * Its parameters are factor = {value!r}.\n" in c_source(model, "pump")
    assert "parameters" not in c_source(fitted("CKA, center"), "pump")
