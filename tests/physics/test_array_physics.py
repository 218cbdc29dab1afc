"""NumPy functions, torch functions and modules, and Physics are told apart."""

import numpy as np
import pytest
import torch

from gpadjust import BlackBoxPhysics, CalibratedPhysics, FunctionPhysics, PhysicsError
from gpadjust.physics import JoinedPhysics
from gpadjust.physics.array_physics import array_physics
from tests.systems import refused

X = np.linspace(0.1, 1, 6).reshape(3, 2)
TENSOR = torch.tensor(X)


@pytest.mark.parametrize(
    "function",
    [
        lambda X: np.sin(X[:, 0]),
        lambda X: X[:, 0] ** 2,  # of both
        lambda X: [row.sum() for row in X],
        np.squeeze,  # a single number of a single row would be no array
    ],
)
def test_a_numpy_function(function):
    assert type(array_physics(function, X[:, :1])) is BlackBoxPhysics


@pytest.mark.parametrize(
    "function",
    [
        torch.sin,
        lambda X: X.sin(),
        lambda X: torch.cat([X[:, :1].exp(), X[:, 1:]], dim=1),
        lambda X: torch.as_tensor(X) * 2,
        torch.nn.Linear(2, 1).double(),
    ],
)
def test_a_torch_function(function):
    physics = array_physics(function, X)
    assert type(physics) is FunctionPhysics
    torch.testing.assert_close(physics(TENSOR), function(TENSOR))


def test_a_physics_is_taken_as_it_is():
    physics = BlackBoxPhysics(lambda x: x[0], batched=False)
    assert array_physics(physics, X) is physics


def test_a_module_is_copied():
    linear = torch.nn.Linear(2, 1).double()
    assert array_physics(linear, X).function is not linear


def test_several():
    joined = array_physics({"coarse": np.sin, "fine": torch.cos}, X)
    assert isinstance(joined, JoinedPhysics)
    assert joined.names == ("coarse", "fine")
    torch.testing.assert_close(joined(TENSOR), torch.cat([TENSOR.sin(), TENSOR.cos()], dim=1))
    assert array_physics([np.sin, torch.cos], X).names == ("sin", "cos")


def test_one_row_is_asked_and_left_as_it_is():
    asked = []

    def writes(X):
        asked.append(len(X))
        X[:] = 0
        return X[:, 0]

    before = X.copy()
    array_physics(writes, X)
    assert asked == [1]
    assert (before == X).all()


def test_both_errors_are_told():
    def both(X):
        if isinstance(X, np.ndarray):
            raise KeyError("no array")
        raise IndexError("no tensor")

    with pytest.raises(PhysicsError, match=r"(?s)'both'.*KeyError: 'no array'.*IndexError: no ten"):
        array_physics(both, X)


@pytest.mark.parametrize("thing", [3, "cka", CalibratedPhysics])
def test_what_is_no_physics(thing):
    refused(TypeError, "Physics or a callable", array_physics, thing, X)
