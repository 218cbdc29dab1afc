"""Torch functions as physics, and `as_physics`."""

import pickle
import warnings

import cloudpickle
import numpy as np
import pytest
import torch

from gpadjust.physics import (
    BlackBoxPhysics,
    FunctionPhysics,
    PhysicsError,
    Unknown,
    as_physics,
)


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
    with pytest.raises(PhysicsError, match=r"'noodle' computes with NumPy.*BlackBoxPhysics\("):
        FunctionPhysics(function, name="noodle")(points(3, 2).requires_grad_(grad))


def test_numpy_inside_where_a_gradient_is_needed(points):
    physics = FunctionPhysics(lambda X: torch.from_numpy(np.sin(X.numpy())))
    with pytest.raises(PhysicsError, match=r"computes with NumPy.*BlackBoxPhysics\(") as caught:
        physics(points(3, 2).requires_grad_())
    assert "Can't call numpy()" in str(caught.value.__cause__)


def test_other_runtime_errors_are_not_taken_for_numpy(points):
    physics = FunctionPhysics(lambda X: X @ X)
    with pytest.raises(PhysicsError, match="raised RuntimeError: mat1 and mat2"):
        physics(points(3, 2))


def test_missing_gradient_warns_once(points):
    physics = FunctionPhysics(lambda X: X.detach() ** 2, name="stone")
    X = points(3, 2).requires_grad_()
    with pytest.warns(UserWarning, match=r"No gradient flows through physics 'stone'.*BlackBox"):
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


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("dumps", [pickle.dumps, pickle._dumps])
def test_pickle_of_a_lambda_says_what_to_do(dumps, protocol):
    models = torch.nn.ModuleList([FunctionPhysics(lambda X: X, name="ghost")])
    message = r"function of physics 'ghost' cannot be pickled.*<lambda>.*top level.*cloudpickle"
    with pytest.raises(pickle.PicklingError, match=message):
        dumps(models, protocol)


def test_cloudpickle_keeps_a_lambda_and_what_it_shares(points):
    shift = [1.0]
    physics = FunctionPhysics(lambda X: X + shift[0])
    physics(points(3, 2))
    loaded, kept = pickle.loads(cloudpickle.dumps((physics, shift)))
    kept[0] = 2.0
    loaded.forget()
    assert torch.equal(loaded(points(3, 2)), points(3, 2) + 2.0)


def test_pickle_of_a_lambda_that_holds_its_physics(points):
    physics = FunctionPhysics(lambda X: X * len(physics.name))
    loaded = pickle.loads(cloudpickle.dumps(physics))
    assert torch.equal(loaded(points(3, 2)), 8.0 * points(3, 2))
    with pytest.raises(pickle.PicklingError, match="cannot be pickled"):
        pickle.dumps(physics)


@pytest.mark.parametrize("dumps", [pickle.dumps, cloudpickle.dumps])
def test_pickle_of_a_method_that_holds_its_physics(dumps, points):
    loaded = pickle.loads(dumps(Owner()))
    assert torch.equal(loaded.physics(points(3, 2)), points(3, 2) + 1)
    loaded = pickle.loads(dumps(Owner().physics))
    assert torch.equal(loaded(points(3, 2)), points(3, 2) + 1)


def test_as_physics_wraps_callables(points):
    X, physics = points(3, 2), BlackBoxPhysics(np.sin)
    assert as_physics(physics) is physics
    with pytest.raises(TypeError, match="function must be callable; found float"):
        FunctionPhysics(1.0)
    assert isinstance(as_physics(torch.sin), FunctionPhysics)
    assert torch.equal(as_physics(torch.sin)(X), X.sin())
    assert list(as_physics(torch.nn.Linear(2, 1)).parameters())


def test_as_physics_joins_several(points):
    X = points(3, 2)
    for several in ([torch.sin, double], (torch.sin, double), {"a": torch.sin, "b": double}):
        assert torch.equal(as_physics(several)(X), torch.cat([X.sin(), 2 * X], -1))
    physics = FunctionPhysics(double)
    assert as_physics([physics]) is physics
    with pytest.raises(ValueError, match="no physics to join"):
        as_physics([])


@pytest.mark.parametrize(
    ("thing", "found"), [(3.0, "a float"), (None, "a NoneType"), (torch.nn.Tanh, "the class Tanh")]
)
def test_as_physics_rejects_the_rest(thing, found):
    message = f"found {found}.*torch function.*ODEPhysics.*BlackBoxPhysics"
    with pytest.raises(TypeError, match=message):
        as_physics(thing)


PRIOR = Unknown(1.0, factor=2.0)


class TestUnknownParametersOfAModule:
    """`gain` and `shift` are one number each, `weights` are two; `net` is learnt as a network."""

    class Scaled(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
            self.shift = torch.nn.Parameter(torch.tensor([0.5], dtype=torch.float64))
            self.weights = torch.nn.Parameter(torch.ones(2, dtype=torch.float64))
            self.net = torch.nn.Linear(2, 1, dtype=torch.float64)

        def forward(self, X):
            return self.gain * self.net(X) + self.shift + X @ self.weights.unsqueeze(-1)

    def test_are_set_in_it_and_the_others_learnt(self, points):
        module, X, values = self.Scaled(), points(4, 2), points(3, 2, seed=1)
        physics = FunctionPhysics(module, unknowns={"shift": Unknown(0, sd=1), "gain": PRIOR})
        shift, gain = values.unsqueeze(-2).split(1, dim=-1)
        expected = gain * module.net(X) + shift + X @ module.weights.unsqueeze(-1)
        torch.testing.assert_close(physics(X, values), expected)
        assert not module.gain.requires_grad
        assert module.gain.item() == 2.0
        physics(X, values).sum().backward()
        assert module.net.weight.grad.abs().min() > 0

    def test_of_another_name(self):
        message = "The module Scaled has no parameter 'mass'; it has gain, shift, weights, net.weig"
        with pytest.raises(ValueError, match=message):
            FunctionPhysics(self.Scaled(), unknowns={"gain": PRIOR, "mass": PRIOR})

    def test_of_several_numbers(self):
        with pytest.raises(
            ValueError, match=r"a number each; 'weights' of Scaled has shape \(2,\)"
        ):
            FunctionPhysics(self.Scaled(), unknowns={"weights": PRIOR})

    def test_that_it_takes_as_an_argument(self, points):
        class Called(torch.nn.Module):
            def forward(self, X, p):
                return p.gain * X[:, 0]

        X = points(3, 2)
        physics = FunctionPhysics(Called(), unknowns={"gain": PRIOR})
        torch.testing.assert_close(physics(X, torch.tensor([3.0])), 3.0 * X[:, :1])
