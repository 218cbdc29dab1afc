"""What every physics shares: shapes, columns, memo, gradients, checks, copies."""

import copy
import pickle
import re
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, Physics, PhysicsError
from tests.systems import refused

integers_as_rows = st.lists(st.lists(st.integers(-2, 2), min_size=2, max_size=2), min_size=1)


class Scale(torch.nn.Module):
    """`x_0 -> gain * x_0 + offset`, with a parameter and a buffer."""

    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
        self.register_buffer("offset", torch.tensor(0.0, dtype=torch.float64))
        self.calls = 0

    def forward(self, X):
        self.calls += 1
        return self.gain * X[:, 0] + self.offset


def square(X):
    return X**2


class TestShapes:
    @given(batch=st.lists(st.integers(1, 3), max_size=3), n=st.integers(1, 4), grad=st.booleans())
    def test_any_batch_shape_gives_the_plain_function(self, batch, n, grad):
        X = torch.randn(*batch, n, 3, dtype=torch.float64, requires_grad=grad)
        physics = FunctionPhysics(lambda X: torch.stack([X.prod(-1), X[:, 1]], -1))
        expected = torch.stack([X.prod(-1), X[..., 1]], -1)
        assert torch.equal(physics(X), expected)
        assert torch.equal(physics(X), expected)

    def test_one_output_and_no_rows(self, points, counter):
        X = points(4, 3, 2)
        flat = FunctionPhysics(lambda X: X.sum(-1))
        column = FunctionPhysics(lambda X: X.sum(-1, keepdim=True))
        assert flat(X).shape == column(X).shape == (4, 3, 1)
        assert torch.equal(flat(X), column(X))
        assert flat.num_outputs == 1
        physics = FunctionPhysics(counter)
        physics(points(2, 3))
        assert physics(points(4, 0, 3)).shape == (4, 0, 2)
        assert len(counter.rows) == 2

    @pytest.mark.parametrize("grad", [False, True])
    def test_result_has_the_dtype_of_X(self, grad):
        X = torch.tensor([[1.5]], dtype=torch.float64, requires_grad=grad)
        Y = FunctionPhysics(lambda X: X.float())(X)
        assert Y.dtype == torch.float64
        assert Y.requires_grad == grad


def test_it_reads_the_named_columns_in_order(points):
    X = points(2, 5, 4)
    assert torch.equal(FunctionPhysics(lambda X: X, inputs=[-1, 0, -4, 3])(X), X[..., [3, 0, 0, 3]])


def test_bad_settings_and_inputs(points):
    for inputs in ([0.5], "a"):
        says = f"inputs must be a whole number; found {inputs[0]!r}"
        refused(TypeError, says, BlackBoxPhysics, square, inputs=inputs)
    refused(ValueError, "inputs is empty", BlackBoxPhysics, square, inputs=[])
    for X in ([[1.0]], torch.tensor([[1]])):
        refused(TypeError, r"floating-point.*found (list|torch.int64)", FunctionPhysics(square), X)
    for shape in ((3,), (3, 0)):
        says = re.escape(f"batch_shape x n x d; found torch.float64, {shape}")
        refused(ValueError, says, FunctionPhysics(square), points(*shape))
    for column in (2, -3):
        says = rf"inputs=\(0, {column}\); found torch.float64, \(5, 2\)"
        refused(ValueError, says, FunctionPhysics(square, inputs=[0, column]), points(5, 2))
    refused(TypeError, "abstract", Physics)


class TestMemo:
    @given(calls=st.lists(integers_as_rows, min_size=1, max_size=5))
    def test_each_distinct_row_is_evaluated_once(self, calls):
        asked = []

        def record(X):
            asked.extend(tuple(row) for row in X.tolist())
            return X.sum(-1)

        physics = BlackBoxPhysics(record)
        for rows in calls:
            X = torch.tensor(rows, dtype=torch.float64)
            assert torch.equal(physics(X), X.sum(-1, keepdim=True))
        assert len(asked) == len(set(asked)) == len({tuple(row) for rows in calls for row in rows})

    def test_results_changed_in_place_bad_rows_and_new_outputs(self, points):
        X = points(3, 2)
        physics = BlackBoxPhysics(square)
        for _ in range(2):
            physics(X).zero_()
        assert torch.equal(physics(X), X**2)
        asked = []

        def root(X):
            asked.extend(X.flatten().tolist())
            return np.where(X > 0, np.abs(X) ** 0.5, np.nan)

        physics = BlackBoxPhysics(root)
        refused(PhysicsError, "NaN", physics, torch.tensor([[4.0], [-1.0], [9.0]]))
        assert physics(torch.tensor([[4.0], [9.0]])).flatten().tolist() == [2.0, 3.0]
        assert asked == [4.0, -1.0, 9.0]
        physics = BlackBoxPhysics(lambda X: np.repeat(X, len(X), 1))
        physics(points(2, 1))
        refused(PhysicsError, r"64, \(1, 1\), expected.*\(1, 2\), as before", physics, points(3, 1))

    def test_dropped_when_state_or_dtype_changes(self, points):
        three = torch.tensor(3.0).double()
        for change in (
            lambda scale: scale.gain.data.fill_(3.0),
            lambda scale: scale.load_state_dict({"gain": three, "offset": 0 * three}),
            lambda scale: setattr(scale, "gain", torch.nn.Parameter(three.clone())),
            lambda scale: scale.offset.add_(1.0),
        ):
            scale, X = Scale(), points(3, 1)
            physics = BlackBoxPhysics(scale)
            with torch.no_grad():
                before = physics(X)
                physics(X)
                assert scale.calls == 1
                change(scale)
                after = physics(X)
            assert scale.calls == 2
            assert torch.equal(after, scale.gain.detach() * X + scale.offset)
            assert not torch.equal(after, before)
        physics, X = BlackBoxPhysics(lambda X: X / 3), torch.ones(1, 1)
        physics(X)
        assert torch.equal(physics(X.double()), X.double() / 3)


class TestGradients:
    def test_gradient_in_X(self, points):
        physics = FunctionPhysics(lambda X: torch.stack([X.prod(-1), X[:, 0].sin()], -1))
        X = points(2, 3, 2).requires_grad_()
        assert torch.autograd.gradcheck(physics, X)
        assert torch.autograd.gradgradcheck(physics, X)
        physics = FunctionPhysics(square)
        X = points(3, 2)
        physics(X)
        (gradient,) = torch.autograd.grad(physics(X.requires_grad_()).sum(), X)
        assert torch.equal(gradient, 2 * X)

    def test_no_graph_where_none_is_needed(self, points):
        scale = Scale()
        physics = FunctionPhysics(scale)
        X = points(3, 1)
        assert physics(X).requires_grad
        with torch.no_grad():
            assert not physics(X.requires_grad_()).requires_grad
            physics(X)
        scale.requires_grad_(False)
        assert not physics(X.detach()).requires_grad

    def test_expanded_X(self, counter, points):
        X = points(2, 5, 3).requires_grad_()
        Y = FunctionPhysics(counter)(X.unsqueeze(-3).expand(2, 4, 5, 3))
        assert len(counter.rows) == 10
        assert torch.equal(Y, counter.formula(X).unsqueeze(-3).expand(2, 4, 5, 2))
        weights = points(2, 4, 5, 2, seed=1)
        (gradient,) = torch.autograd.grad((weights * Y).sum(), X)
        (expected,) = torch.autograd.grad((weights.sum(1) * counter.formula(X)).sum(), X)
        assert torch.allclose(gradient, expected)
        X = points(1, 2).expand(3, 2).requires_grad_()
        weights = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
        (gradient,) = torch.autograd.grad((weights * FunctionPhysics(square)(X)).sum(), X)
        assert torch.equal(gradient, 2 * weights * X)


class TestChecks:
    @pytest.mark.parametrize("grad", [False, True])
    def test_wrong_result(self, grad, points):
        for result, says in (
            (None, r"returned NoneType, expected a real tensor of shape \(4, m\)"),
            (torch.zeros(4, dtype=torch.complex128), "returned torch.complex128"),
            (torch.zeros(3, 1), r"returned torch.float.., \(3, 1\), expected.*\(4, m\) or \(4,\)"),
            (torch.tensor(1.0), r"returned torch.float.., \(\).*0 \* X\[:, 0\] \+ value.*BlackBox"),
            (torch.zeros(4, 1, 1), r"returned torch.float.., \(4, 1, 1\)"),
            (torch.zeros(4, 0), r"returned torch.float.., \(4, 0\)"),
        ):
            physics = FunctionPhysics(lambda X, result=result: result, name="wrong")
            X = points(4, 2).requires_grad_(grad)
            refused(PhysicsError, "Physics 'wrong' " + says, physics, X)
        overflow = FunctionPhysics(lambda X: X.double() * 1e300)
        refused(PhysicsError, "NaN or inf in 1 of 1", overflow, torch.ones(1, 1))

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
    @pytest.mark.parametrize("grad", [False, True])
    def test_not_finite_names_rows_of_the_flattened_X(self, value, grad):
        physics = FunctionPhysics(lambda X: torch.where(X > 6, value, X), name="spike")
        X = torch.arange(9.0).reshape(3, 3, 1).requires_grad_(grad)
        with pytest.raises(PhysicsError, match=r"'spike'.*NaN or inf in 2 of 9") as caught:
            physics(X)
        assert caught.value.rows == (7, 8)
        assert caught.value.inputs.tolist() == [[7.0], [8.0]]
        assert str(caught.value).endswith("  row 7: [7.0]\n  row 8: [8.0]")

    def test_rows_are_told_for_every_copy_and_of_an_inner_physics(self):
        physics = FunctionPhysics(lambda X: X.log(), inputs=[0])
        X = torch.tensor([[1.0, 5.0], [0.0, 5.0], [0.0, 6.0]])
        physics(X[:1])
        with pytest.raises(PhysicsError, match="NaN or inf") as caught:
            physics(X.expand(2, 3, 2))
        assert caught.value.rows == (1, 2, 4, 5)
        assert caught.value.inputs.tolist() == [[0.0]] * 4
        inner = FunctionPhysics(lambda X: X.log(), name="inner")
        outer = FunctionPhysics(lambda X: inner(X.flip(0)), name="outer")
        with pytest.raises(PhysicsError, match="'inner'") as caught:
            outer(torch.tensor([[0.0], [1.0]]))
        assert caught.value.rows == (1,)
        assert caught.value.inputs.tolist() == [[0.0]]

    @pytest.mark.parametrize("grad", [False, True])
    def test_exception_is_chained(self, grad, points):
        def broken(X):
            raise KeyError("mass")

        message = r"(?s)'broken' raised KeyError: 'mass'.*for 3 row.*row 2"
        with pytest.raises(PhysicsError, match=message) as caught:
            FunctionPhysics(broken)(points(3, 2).requires_grad_(grad))
        assert isinstance(caught.value.__cause__, KeyError)
        assert caught.value.rows == (0, 1, 2)

    def test_physics_errors_pass_through(self, points):
        raised = PhysicsError("Out of fuel:", rows=[1])

        def broken(X):
            raise raised

        with pytest.raises(PhysicsError, match=r"^Out of fuel:\n  row 1: ") as caught:
            FunctionPhysics(broken)(points(3, 2))
        assert caught.value is raised


class TestCopies:
    def test_copies_and_pickles(self, points):
        physics, X = FunctionPhysics(square), points(3, 2)
        assert copy.deepcopy({"model": [physics]})["model"][0] is physics
        assert torch.equal(copy.copy(physics)(X), physics(X))
        physics = FunctionPhysics(Scale(), name="spring")
        X = points(3, 1)
        with torch.no_grad():
            expected = physics(X)
            duplicate = copy.deepcopy(physics)
            duplicate.function.gain.fill_(7.0)
            assert torch.equal(duplicate(X), 7.0 * X)
            assert torch.equal(physics(X), expected)
        assert (duplicate.name, duplicate.num_outputs) == ("spring", 1)
        physics = BlackBoxPhysics(Scale())
        X = points(3, 1)
        with torch.no_grad():
            expected = physics(X)
            loaded = pickle.loads(pickle.dumps(physics))
            assert torch.equal(loaded(X), expected)
            loaded.function.gain.fill_(5.0)
            assert torch.equal(loaded(X), 5.0 * X)


class TestThreads:
    def test_forget_holds_for_rows_under_evaluation(self, points):
        inside, go = threading.Event(), threading.Event()

        def slow(X):
            inside.set()
            assert go.wait(10)
            return X

        physics = FunctionPhysics(slow)
        with ThreadPoolExecutor() as pool:
            result = pool.submit(physics, points(3, 1))
            assert inside.wait(10)
            physics.forget()
            go.set()
            assert torch.equal(result.result(), points(3, 1))
        inside.clear()
        physics(points(3, 1))
        assert inside.is_set()


def test_a_subclass_needs_only_evaluate(points):
    class Drag(Physics):
        def evaluate(self, X):
            return -X * X.abs()

    X = points(3, 2)
    drag = Drag(inputs=[1])
    assert drag.name == "Drag"
    assert torch.equal(drag(X), -X[:, 1:] * X[:, 1:].abs())


# What a PhysicsError says and carries


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
