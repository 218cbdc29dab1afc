"""Torch functions as physics, and `as_physics`."""

import pickle
import warnings

import cloudpickle
import numpy as np
import pytest
import torch

from gpadjust import CalibratedPhysics
from gpadjust.physics import (
    BlackBoxPhysics,
    FunctionPhysics,
    JoinedPhysics,
    PhysicsError,
    Unknown,
    as_physics,
)
from gpadjust.physics.array_physics import array_physics
from tests.systems import refused


def test_is_named_after_its_function():
    assert FunctionPhysics(torch.sin).name == "sin"
    assert FunctionPhysics(torch.nn.Tanh()).name == "Tanh"
    assert FunctionPhysics(torch.sin, name="wave").name == "wave"


def test_parameters_of_a_module_are_learnt(points):
    physics = FunctionPhysics(torch.nn.Linear(3, 2, dtype=torch.float64))
    X = points(20, 3)
    target = X @ points(3, 2, seed=1) + 1.0
    optimizer = torch.optim.LBFGS(physics.parameters(), max_iter=50)

    def loss():
        optimizer.zero_grad()
        value = (physics(X) - target).square().mean()
        value.backward()
        return value

    optimizer.step(loss)
    assert torch.allclose(physics(X), target, atol=1e-4)
    assert torch.allclose(physics.function.bias, torch.ones(2, dtype=torch.float64), atol=1e-4)


@pytest.mark.parametrize("grad", [False, True])
@pytest.mark.parametrize(
    "function", [lambda X: X.detach().numpy() ** 2, lambda X: X.detach().numpy().sum()]
)
def test_numpy_result(function, grad, points):
    with pytest.raises(PhysicsError, match=r"'noodle'.*NumPy.*BlackBoxPhysics\("):
        FunctionPhysics(function, name="noodle")(points(3, 2).requires_grad_(grad))


def test_numpy_inside_where_a_gradient_is_needed(points):
    physics = FunctionPhysics(lambda X: torch.from_numpy(np.sin(X.numpy())))
    with pytest.raises(PhysicsError, match=r"NumPy.*BlackBoxPhysics\(") as caught:
        physics(points(3, 2).requires_grad_())
    assert "Can't call numpy()" in str(caught.value.__cause__)


def test_other_runtime_errors_are_not_taken_for_numpy(points):
    physics = FunctionPhysics(lambda X: X @ X)
    refused(PhysicsError, r"RuntimeError: .*mat1", physics, points(3, 2))


def test_missing_gradient_warns_once(points):
    physics = FunctionPhysics(lambda X: X.detach() ** 2, name="stone")
    X = points(3, 2).requires_grad_()
    with pytest.warns(UserWarning, match=r"No gradient.*'stone'.*BlackBox"):
        assert torch.equal(physics(X), X.detach() ** 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        physics(X)


def test_no_warning_where_a_gradient_flows(points):
    physics = FunctionPhysics(torch.sin)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        physics(points(3, 2).requires_grad_())
        physics(points(3, 2))


def double(X):
    return 2 * X


class Owner:
    """Something that holds a physics made of its own method."""

    def __init__(self):
        self.physics = FunctionPhysics(self.formula)

    def formula(self, X):
        return X + 1


def test_cloudpickle_keeps_a_lambda_and_what_it_shares(points):
    shift = [1.0]
    physics = FunctionPhysics(lambda X: X + shift[0])
    physics(points(3, 2))
    loaded, kept = pickle.loads(cloudpickle.dumps((physics, shift)))
    kept[0] = 2.0
    loaded.forget()
    assert torch.equal(loaded(points(3, 2)), points(3, 2) + 2.0)


@pytest.mark.parametrize("dumps", [pickle.dumps, cloudpickle.dumps])
def test_pickle_of_a_method_that_holds_its_physics(dumps, points):
    loaded = pickle.loads(dumps(Owner()))
    assert torch.equal(loaded.physics(points(3, 2)), points(3, 2) + 1)
    loaded = pickle.loads(dumps(Owner().physics))
    assert torch.equal(loaded(points(3, 2)), points(3, 2) + 1)


def test_as_physics_wraps_callables(points):
    X, physics = points(3, 2), BlackBoxPhysics(np.sin)
    assert as_physics(physics) is physics
    refused(TypeError, "callable; found float", FunctionPhysics, 1.0)
    assert isinstance(as_physics(torch.sin), FunctionPhysics)
    assert torch.equal(as_physics(torch.sin)(X), X.sin())
    assert list(as_physics(torch.nn.Linear(2, 1)).parameters())


def test_as_physics_joins_several(points):
    X = points(3, 2)
    for several in ([torch.sin, double], (torch.sin, double), {"a": torch.sin, "b": double}):
        assert torch.equal(as_physics(several)(X), torch.cat([X.sin(), 2 * X], -1))
    physics = FunctionPhysics(double)
    assert as_physics([physics]) is physics
    refused(ValueError, "no physics to join", as_physics, [])


@pytest.mark.parametrize(
    ("thing", "found"), [(3.0, "a float"), (None, "a NoneType"), (torch.nn.Tanh, "the class Tanh")]
)
def test_as_physics_rejects_the_rest(thing, found):
    message = f"found {found}.*torch function.*ODEPhysics.*BlackBoxPhysics"
    refused(TypeError, message, as_physics, thing)


PRIOR = Unknown(1.0, factor=2.0)


# NumPy functions, torch functions and modules, and Physics are told apart


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
