"""Torch functions as physics, and `as_physics`."""

import warnings

import numpy as np
import pytest
import torch

from gpadjust import CalibratedPhysics
from gpadjust.physics import (
    BlackBoxPhysics,
    FunctionPhysics,
    PhysicsError,
    as_physics,
)
from gpadjust.physics.function import array_physics
from tests.systems import refused


def test_names():
    assert FunctionPhysics(torch.sin).name == "sin"
    assert FunctionPhysics(torch.nn.Tanh()).name == "Tanh"
    assert FunctionPhysics(torch.sin, name="wave").name == "wave"


@pytest.mark.parametrize("grad", [False, True])
def test_numpy_results_and_other_errors(grad, points):
    X = points(3, 2).requires_grad_(grad)
    for function in (lambda X: X.detach().numpy() ** 2, lambda X: X.detach().numpy().sum()):
        physics = FunctionPhysics(function, name="noodle")
        refused(PhysicsError, r"'noodle'.*NumPy.*BlackBoxPhysics\(", physics, X)
    physics = FunctionPhysics(lambda X: X @ X)
    refused(PhysicsError, r"RuntimeError: .*mat1", physics, X)
    if grad:
        physics = FunctionPhysics(lambda X: torch.from_numpy(np.sin(X.numpy())))
        refused(PhysicsError, r"RuntimeError: Can't call numpy\(\)", physics, X)


def test_missing_gradient_warns_once(points):
    physics, smooth = FunctionPhysics(lambda X: X.detach() ** 2, name="stone"), torch.sin
    X = points(3, 2).requires_grad_()
    with pytest.warns(UserWarning, match=r"No gradient.*'stone'.*BlackBox"):
        assert torch.equal(physics(X), X.detach() ** 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        physics(X)
        FunctionPhysics(smooth)(X)
        FunctionPhysics(smooth)(points(3, 2))


def test_as_physics(points):
    X, physics = points(3, 2), BlackBoxPhysics(np.sin)
    assert as_physics(physics) is physics
    assert isinstance(as_physics(torch.sin), FunctionPhysics)
    assert torch.equal(as_physics(torch.sin)(X), X.sin())
    assert list(as_physics(torch.nn.Linear(2, 1)).parameters())
    refused(TypeError, "callable; found float", FunctionPhysics, 1.0)
    for thing, found in (
        (3.0, "a float"),
        ([torch.sin], "a list"),
        (None, "a NoneType"),
        (torch.nn.Tanh, "a type, <class.*Tanh"),
    ):
        says = f"found {found}.*torch function.*ODEPhysics.*BlackBoxPhysics"
        refused(TypeError, says, as_physics, thing)


# NumPy functions, torch functions and modules, and Physics are told apart


X = np.linspace(0.1, 1, 6).reshape(3, 2)
TENSOR = torch.tensor(X)


def test_functions_are_told_apart():
    for function in (
        lambda X: np.sin(X[:, 0]),
        lambda X: X[:, 0] ** 2,  # of both
        lambda X: [row.sum() for row in X],
        np.squeeze,  # a single number of a single row would be no array
    ):
        assert type(array_physics(function, X[:, :1])) is BlackBoxPhysics
    linear = torch.nn.Linear(2, 1).double()
    for function in (
        torch.sin,
        lambda X: X.sin(),
        lambda X: torch.cat([X[:, :1].exp(), X[:, 1:]], dim=1),
        lambda X: torch.as_tensor(X) * 2,
        linear,
    ):
        physics = array_physics(function, X)
        assert type(physics) is FunctionPhysics
        torch.testing.assert_close(physics(TENSOR), function(TENSOR))
    assert physics.function is not linear  # a module is copied
    physics = BlackBoxPhysics(lambda x: x[0], batched=False)
    assert array_physics(physics, X) is physics


def test_a_function_is_called_with_a_copy_of_one_row():
    asked = []

    def writes(X):
        asked.append(len(X))
        X[:] = 0
        return X[:, 0]

    before = X.copy()
    array_physics(writes, X)
    assert asked == [1]
    assert (before == X).all()


def test_errors_of_both_and_what_is_no_physics():
    def both(X):
        if isinstance(X, np.ndarray):
            raise KeyError("no array")
        raise IndexError("no tensor")

    says = r"(?s)'both'.*KeyError: 'no array'.*IndexError: no ten"
    refused(PhysicsError, says, array_physics, both, X)
    for thing in (3, "cka", CalibratedPhysics):
        refused(TypeError, "Physics or a callable", array_physics, thing, X)
