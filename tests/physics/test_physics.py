"""What every physics shares: shapes, columns, gradients, checks, copies; and torch functions."""

import copy
import pickle
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, Physics, PhysicsError, as_physics
from gpadjust.physics.function import array_physics
from tests.physics.conftest import Scale
from tests.systems import normal, refused


def square(X):
    return X**2


@given(batch=st.lists(st.integers(1, 3), max_size=3), n=st.integers(1, 4))
def test_any_batch_shape_gives_the_plain_function(batch, n):
    X = torch.randn(*batch, n, 3, dtype=torch.float64)
    physics = FunctionPhysics(lambda X: torch.stack([X.prod(-1), X[:, 1]], -1))
    assert torch.equal(physics(X), torch.stack([X.prod(-1), X[..., 1]], -1))


def test_one_output_no_rows_and_columns():
    X = normal(4, 3, 2)
    flat = FunctionPhysics(lambda X: X.sum(-1))
    column = FunctionPhysics(lambda X: X.sum(-1, keepdim=True))
    assert flat(X).shape == column(X).shape == (4, 3, 1)
    assert torch.equal(flat(X), column(X))
    assert flat.num_outputs == 1
    flat.function = None  # no rows are no call
    assert flat(X[:, :0]).shape == (4, 0, 1)
    X = normal(2, 5, 4)
    assert torch.equal(FunctionPhysics(lambda X: X, inputs=[-1, 0, -4, 3])(X), X[..., [3, 0, 0, 3]])


# Gradients


def test_gradients_where_they_are_needed():
    physics = FunctionPhysics(lambda X: torch.stack([X.prod(-1), X[:, 0].sin()], -1))
    X = normal(2, 3, 2).requires_grad_()
    assert torch.autograd.gradcheck(physics, X)
    assert torch.autograd.gradgradcheck(physics, X)
    Y = FunctionPhysics(lambda X: X.float())(X)
    assert (Y.dtype, Y.requires_grad) == (torch.float64, True)
    scale, X = Scale(), normal(3, 1)
    physics = FunctionPhysics(scale)
    assert physics(X).requires_grad
    with torch.no_grad():
        assert not physics(X.requires_grad_()).requires_grad
    scale.requires_grad_(False)
    assert not physics(X.detach()).requires_grad


def test_expanded_X_is_evaluated_once():
    rows = []

    def formula(X):
        return torch.stack([X.square().sum(-1), X[..., 0].sin()], dim=-1)

    X, weights = normal(2, 5, 3).requires_grad_(), normal(2, 4, 5, 2, seed=1)
    physics = FunctionPhysics(lambda X: rows.append(len(X)) or formula(X))
    Y = physics(X.unsqueeze(-3).expand(2, 4, 5, 3))
    assert rows == [10]
    assert torch.equal(Y, formula(X).unsqueeze(-3).expand(2, 4, 5, 2))
    (gradient,) = torch.autograd.grad((weights * Y).sum(), X)
    (expected,) = torch.autograd.grad((weights.sum(1) * formula(X)).sum(), X)
    assert torch.allclose(gradient, expected)
    X = normal(1, 2).expand(3, 2).requires_grad_()  # a leaf
    weights = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weights * FunctionPhysics(square)(X)).sum(), X)
    assert torch.equal(gradient, 2 * weights * X)


def test_missing_gradient_warns_once():
    physics, X = FunctionPhysics(lambda X: X.detach() ** 2, name="stone"), normal(3, 2)
    with pytest.warns(UserWarning, match=r"No gradient.*'stone'.*BlackBox"):
        assert torch.equal(physics(X.requires_grad_()), X.detach() ** 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        physics(X)
        FunctionPhysics(torch.sin)(X)
        FunctionPhysics(torch.sin)(X.detach())


# Checks


@pytest.mark.parametrize("grad", [False, True])
def test_wrong_results(grad):
    X = normal(4, 2).requires_grad_(grad)
    for function, says in (
        (None, r"returned NoneType, expected a real tensor of shape \(4, m\)"),
        (torch.zeros(4, dtype=torch.complex128), "returned torch.complex128"),
        (torch.zeros(3, 1), r"returned torch.float.., \(3, 1\), expected.*\(4, m\) or \(4,\)"),
        (torch.tensor(1.0), r"returned torch.float.., \(\).*0 \* X\[:, 0\] \+ value.*BlackBox"),
        (torch.zeros(4, 1, 1), r"returned torch.float.., \(4, 1, 1\)"),
        (torch.zeros(4, 0), r"returned torch.float.., \(4, 0\)"),
        (lambda X: X.detach().numpy() ** 2, r"NumPy.*BlackBoxPhysics\("),
        (lambda X: X.double() * 1e308 * 1e9, "NaN or inf in 4 of 4"),
    ):
        call = function if callable(function) else lambda X, result=function: result
        physics = FunctionPhysics(call, name="wrong")
        refused(PhysicsError, "Physics 'wrong' .*" + says, physics, X)
    overflow = FunctionPhysics(lambda X: X.double() * 1e300)  # in the conversion to float32
    refused(PhysicsError, "NaN or inf in 1 of 1", overflow, torch.ones(1, 1))
    if grad:
        physics = FunctionPhysics(lambda X: torch.from_numpy(np.sin(X.numpy())))
        refused(PhysicsError, r"RuntimeError: Can't call numpy\(\)", physics, X)
    physics = BlackBoxPhysics(lambda X: np.repeat(X, len(X), 1))
    physics(normal(2, 1))
    refused(PhysicsError, r"64, \(1, 1\), expected.*\(1, 2\), as before", physics, normal(3, 1))


@pytest.mark.parametrize("grad", [False, True])
def test_rows_are_named_for_every_copy_and_of_an_inner_physics(grad):
    physics = FunctionPhysics(lambda X: X.log(), inputs=[0], name="spike")
    X = torch.tensor([[1.0, 5.0], [0.0, 5.0], [-1.0, 6.0]]).requires_grad_(grad)
    with pytest.raises(PhysicsError, match=r"'spike'.*NaN or inf in 2 of 3") as caught:
        physics(X)
    assert str(caught.value).endswith("  row 1: [0.0]\n  row 2: [-1.0]")
    X = X.detach().expand(2, 3, 2).requires_grad_(grad)
    with pytest.raises(PhysicsError, match="NaN or inf") as caught:
        physics(X)
    assert caught.value.rows == (1, 2, 4, 5)
    assert caught.value.inputs.tolist() == [[0.0], [-1.0]] * 2
    inner = FunctionPhysics(lambda X: X.log(), name="inner")
    outer = FunctionPhysics(lambda X: inner(X.flip(0)), name="outer")
    with pytest.raises(PhysicsError, match="'inner'") as caught:
        outer(torch.tensor([[0.0], [1.0]]))
    assert caught.value.rows == (1,)
    assert caught.value.inputs.tolist() == [[0.0]]


@pytest.mark.parametrize("grad", [False, True])
def test_exceptions_are_chained_and_errors_of_a_physics_pass(grad):
    def broken(X):
        raise error

    X, error = normal(3, 2).requires_grad_(grad), KeyError("mass")
    message = r"(?s)'broken' raised KeyError: 'mass'.*for 3 row.*row 2"
    with pytest.raises(PhysicsError, match=message) as caught:
        FunctionPhysics(broken)(X)
    assert caught.value.__cause__ is error
    assert caught.value.rows == (0, 1, 2)
    error = PhysicsError("Out of fuel:", rows=[1])
    with pytest.raises(PhysicsError, match=r"^Out of fuel:\n  row 1: ") as caught:
        FunctionPhysics(broken)(X)
    assert caught.value is error


def test_errors_and_their_rows():
    error = PhysicsError("It broke:", rows=range(10, 17))
    error.inputs = torch.arange(7.0).unsqueeze(-1)
    for one in (error, pickle.loads(pickle.dumps(error))):
        lines = str(one).splitlines()
        assert lines[:2] == ["It broke:", "  row 10: [0.0]"]
        assert lines[5:] == ["  row 14: [4.0]", "  and 2 more"]
        assert one.rows == tuple(range(10, 17))
    assert "more" not in str(PhysicsError("It broke:", rows=range(5)))
    assert str(PhysicsError("It broke.")) == "It broke."


# Copies and kinds


def test_copies_and_pickles():
    X = normal(3, 1)
    plain = FunctionPhysics(square)
    assert copy.deepcopy({"model": [plain]})["model"][0] is plain
    assert torch.equal(copy.copy(plain)(X), plain(X))
    for kind in (FunctionPhysics, BlackBoxPhysics):
        physics = kind(Scale(), name="spring")
        with torch.no_grad():
            expected = physics(X)
            for again in (copy.deepcopy(physics), pickle.loads(pickle.dumps(physics))):
                assert torch.equal(again(X), expected)
                again.function.gain.fill_(7.0)
                assert torch.equal(again(X), 7.0 * X)
                assert torch.equal(physics(X), expected)
                assert (again.name, again.num_outputs) == ("spring", 1)


def test_names_and_a_subclass_that_has_evaluate_alone():
    class Drag(Physics):
        def evaluate(self, X):
            return -X * X.abs()

    X, drag = normal(3, 2), Drag(inputs=[1])
    assert torch.equal(drag(X), -X[:, 1:] * X[:, 1:].abs())
    sines = FunctionPhysics(torch.sin), FunctionPhysics(torch.sin, name="wave")
    kinds = (drag, *sines, FunctionPhysics(torch.nn.Tanh()))
    assert [physics.name for physics in kinds] == ["Drag", "sin", "wave", "Tanh"]


ARRAY = np.linspace(0.1, 1, 6).reshape(3, 2)


def test_functions_of_numpy_and_torch_are_told_apart():
    rows = []
    for function in (
        lambda X: rows.append(len(X)) or np.sin(X[:, 0]),
        lambda X: X[:, 0] ** 2,  # of both
        lambda X: [row.sum() for row in X],
        lambda X: X.__setitem__(slice(None), 0) or X[:, 0],  # a copy
        np.squeeze,  # a single number of a single row would be no array
    ):
        assert type(array_physics(function, ARRAY[:, :1])) is BlackBoxPhysics
    assert rows == [1]
    assert ARRAY.min() > 0
    linear = torch.nn.Linear(2, 1).double()
    for function in (torch.sin, lambda X: X.sin(), lambda X: torch.as_tensor(X) * 2, linear):
        physics = array_physics(function, ARRAY)
        assert type(physics) is FunctionPhysics
        X = torch.tensor(ARRAY)
        torch.testing.assert_close(physics(X), function(X))
    assert physics.function is not linear  # a module is copied
    physics = BlackBoxPhysics(lambda x: x[0], batched=False)
    assert array_physics(physics, ARRAY) is as_physics(physics) is physics


def no_argument(X):
    raise KeyError("no array") if isinstance(X, np.ndarray) else IndexError("no tensor")


PLAIN, POINTS = FunctionPhysics(square), normal(5, 2)
OUTSIDE = r"inputs=\(0, {}\); found torch.float64, \(5, 2\)"
CALLABLE = "found {}.*torch function.*ODEPhysics.*BlackBoxPhysics"
REFUSED = [
    (TypeError, "inputs must be a whole", lambda: BlackBoxPhysics(square, inputs=[0.5])),
    (ValueError, "inputs is empty", lambda: BlackBoxPhysics(square, inputs=[])),
    (ValueError, "Unknown gradient", lambda: BlackBoxPhysics(square, gradient="autograd")),
    (ValueError, "fd_step must be finite", lambda: BlackBoxPhysics(square, fd_step=0.0)),
    (TypeError, "callable; found list", lambda: BlackBoxPhysics([])),
    (TypeError, "abstract", Physics),
    (TypeError, r"floating-point.*found list", lambda: PLAIN([[1.0]])),
    (TypeError, r"floating-point.*found torch.int64", lambda: PLAIN(torch.tensor([[1]]))),
    (ValueError, r"n x d; found torch.float64, \(3,\)", lambda: PLAIN(normal(3))),
    (ValueError, r"n x d; found torch.float64, \(3, 0\)", lambda: PLAIN(normal(3, 0))),
    (ValueError, OUTSIDE.format(2), lambda: FunctionPhysics(square, inputs=[0, 2])(POINTS)),
    (ValueError, OUTSIDE.format(-3), lambda: FunctionPhysics(square, inputs=[0, -3])(POINTS)),
    (TypeError, CALLABLE.format("a list"), lambda: as_physics([torch.sin])),
    (TypeError, CALLABLE.format("a type, <class.*Tanh"), lambda: as_physics(torch.nn.Tanh)),
    (TypeError, "Physics or a callable", lambda: array_physics("cka", ARRAY)),
    (
        PhysicsError,
        r"(?s)'no_argument'.*KeyError: 'no array'.*IndexError: no ten",
        lambda: array_physics(no_argument, ARRAY),
    ),
]


def test_refusals():
    for case in REFUSED:
        refused(*case)


def test_results_of_a_physics_inside_are_not_those_of_the_outer_one():
    """Also where some rows fail: its others would be taken for outputs in other units."""
    inner = FunctionPhysics(lambda X: (100 * X[:, :1]).where(X[:, :1] < 2, torch.nan))
    outer = FunctionPhysics(lambda X: 0 * inner(X))
    X = torch.rand(3, 1, dtype=torch.float64)
    assert (outer(X) == 0).all()
    assert outer.or_nan(torch.cat([X, X + 5])).isnan().all()
    found = outer.or_nan(torch.stack([X, X + 5]))
    assert (found[0] == 0).all()
    assert found[1].isnan().all()
