"""NumPy functions and simulators as physics: values, gradients, failures, parallel calls, memo."""

import copy
import pickle
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from functools import partial

import cloudpickle
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gpadjust.physics import BlackBoxPhysics, PhysicsError, Unknown
from gpadjust.physics.black_box import RowMemo, row_keys
from tests.physics.conftest import Scale
from tests.systems import normal, refused


def waves(X):
    """For rows or one row: `[sin(x_0) exp(x_1), x_0 x_1^2]`."""
    return np.stack([np.sin(X[..., 0]) * np.exp(X[..., 1]), X[..., 0] * X[..., 1] ** 2], -1)


def torch_waves(X):
    return torch.stack([X[..., 0].sin() * X[..., 1].exp(), X[..., 0] * X[..., 1] ** 2], -1)


class Counter:
    """`[sum(x^2), sin(x_0)]` of rows, which it records."""

    def __init__(self):
        self.rows = []

    def __call__(self, X):
        self.rows += map(tuple, X.tolist())
        return np.stack([np.square(X).sum(-1), np.sin(X[:, 0])], axis=-1)


def locked(lock, X):
    with lock:
        return waves(X)


@pytest.mark.parametrize("batched", [True, False])
def test_rows_are_float64_columns_that_the_function_may_overwrite(batched):
    buffer, dtypes = np.zeros(1), []

    def vandal(x):
        dtypes.append(x.dtype)
        buffer[0] = x.flat[0]
        x[:] = 99.0
        return buffer

    X = torch.tensor([[5.0, 1.0]], dtype=torch.float32)
    physics = BlackBoxPhysics(vandal, batched=batched, inputs=[1])
    first = physics(X)
    physics(X + 1)
    assert X[0, 1].item() == first.item() == 1.0
    assert first.dtype == torch.float32
    assert {*dtypes} == {np.dtype(np.float64)}


# Gradients


def test_gradients_of_repeated_rows_are_not_remembered():
    counter = Counter()
    physics = BlackBoxPhysics(counter)
    x = normal(1, 2).requires_grad_()
    physics(x.expand(3, 1, 2)).sum().backward()
    assert len(counter.rows) == 1 + 4
    for repeated in (x.expand(3, 1, 2), x.repeat(3, 1)):
        x.grad = None
        physics(repeated).sum().backward()
        expected = 3 * (2 * x.detach() + torch.tensor([[1.0, 0.0]]) * x.detach().cos())
        assert torch.allclose(x.grad, expected)
    counter.rows.clear()
    for number in (1, 2):
        Y = physics(normal(3, 2, seed=1).requires_grad_())
        assert len(counter.rows) == 3 + (number - 1) * 2 * 2 * 3
        Y.sum().backward()
        assert len(counter.rows) == 3 + number * 2 * 2 * 3


def test_steps_of_the_differences():
    def slopes(function, X, step=None):
        X = X.clone().requires_grad_()
        return torch.autograd.grad(BlackBoxPhysics(function, fd_step=step)(X).sum(), X)[0]

    counter = Counter()
    slopes(counter, torch.zeros(1, 2).double(), h := 0.5)
    assert {*counter.rows[1:]} == {(h, 0), (-h, 0), (0, h), (0, -h)}
    X = normal(6, 2)  # exact for quadratics
    assert torch.allclose(slopes(np.square, X, 0.5), 2 * X, rtol=1e-12, atol=1e-12)
    X = torch.tensor([[1e9]], dtype=torch.float64)  # a step that floats can tell apart
    assert torch.allclose(slopes(lambda X: 3 * X, X), torch.tensor(3.0).double())
    assert slopes(lambda X: X, X, 1.7e-7).item() == 1.0  # counted as rounded


def test_second_derivatives_and_none():
    X = normal(3, 2).requires_grad_()
    Y = BlackBoxPhysics(waves)(X).sum() + (X**3).sum()
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        torch.autograd.grad(Y, X, create_graph=True)
    physics = BlackBoxPhysics(waves, gradient=None, name="mill")
    with pytest.warns(UserWarning, match=r"No gradient.*'mill'.*'with_grad': False"):
        assert not physics(X).requires_grad
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.allclose(physics(X), torch_waves(X))


UNKNOWNS = {"gain": Unknown(1.0, sd=1.0), "rate": Unknown(2.0, factor=1.5)}


def test_failure_in_finite_differences_names_the_row():
    physics = BlackBoxPhysics(np.sqrt)
    X = torch.tensor([[4.0, 1.0], [0.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    Y = physics(X.requires_grad_())
    words = r"(?s)NaN or inf.*row 1: \[0.0, 1.0\]"
    with np.errstate(invalid="ignore"), pytest.raises(PhysicsError, match=words) as caught:
        Y.sum().backward()
    assert caught.value.rows == (1,)
    assert "step smaller" in caught.value.__notes__[0]
    physics = BlackBoxPhysics(lambda x, p: np.sqrt(x[:, 0] - p.gain), unknowns=UNKNOWNS)
    X = torch.tensor([[4.0], [1.0]], dtype=torch.float64).requires_grad_()
    Y = physics(X, torch.tensor([[0.0, 2.0], [1.0, 2.0]], dtype=torch.float64))
    with np.errstate(invalid="ignore"), pytest.raises(PhysicsError) as caught:
        Y.sum().backward()
    assert caught.value.rows == (3,)
    assert caught.value.inputs.tolist() == [[1.0, 1.0, 2.0]]


# Failures


def test_wrong_results():
    for function, batched, says in (
        (lambda x: x[0] + x[1], True, r"single row, set batched=False"),
        (lambda x: np.zeros((2, 2)), False, r"a scalar or outputs.*found \(2, 2\)"),
        (lambda x: 1j, True, "expected real numbers, found complex"),
        (lambda x: [None], False, "expected real numbers, found None"),
        (lambda x: "1", False, "expected real numbers, found <U1"),
    ):
        physics = BlackBoxPhysics(function, batched=batched, name="mill")
        refused(PhysicsError, rf"Physics 'mill' .*{says}", physics, normal(3, 2))
    for function in (lambda X: X[0, 9], lambda X: 1.0):  # nor is the advice what it is
        with pytest.raises(PhysicsError, match="set batched=False") as caught:
            BlackBoxPhysics(function)(normal(3, 2))
        assert "BlackBoxPhysics" not in str(caught.value)


def test_rows_of_different_length():
    exact = BlackBoxPhysics(lambda x: Fraction(1, 4), batched=False)
    assert exact(torch.ones(1, 1)).item() == 0.25

    def fragile(x):
        return np.zeros(int(x[0])) if x[0] else np.array([1 // 0])

    tape = BlackBoxPhysics(fragile, batched=False, name="tape")
    with pytest.raises(PhysicsError, match=r"found other than 2 output\(s\)") as caught:
        tape(torch.tensor([[2.0], [3.0], [2.0]]))
    assert caught.value.rows == (1,)
    tape(torch.tensor([[2.0]]))  # nor is it hidden by rows that fail
    rows = torch.tensor([[3.0], [0.0]])
    refused(PhysicsError, r"\(2, 3\), expected.*\(2, 2\)", tape, rows)


@pytest.mark.parametrize("grad", [False, True])
def test_good_rows_survive_failed_ones(grad):
    asked = []

    def fragile(x):
        asked.append(x[0])
        if x[0] < 0:
            raise ArithmeticError(f"below zero at {x[0]}")
        return np.sqrt(x[0])

    physics = BlackBoxPhysics(fragile, batched=False)
    X = torch.tensor([[4.0], [-1.0], [9.0], [-2.0]], dtype=torch.float64, requires_grad=grad)
    message = (
        r"(?s)'fragile' raised ArithmeticError: below zero at -1.0.*2 failed row\(s\) of 4"
        r".*row 1: \[-1.0\].*row 3: \[-2.0\]"
    )
    with pytest.raises(PhysicsError, match=message) as caught:
        physics(X)
    assert caught.value.rows == (1, 3)
    assert isinstance(caught.value.__cause__, ArithmeticError)
    assert physics(X[[0, 2]]).flatten().tolist() == [2.0, 3.0]
    assert asked == [4.0, -1.0, 9.0, -2.0]
    whole = BlackBoxPhysics(lambda X: np.where(X > 0, np.abs(X) ** 0.5, np.nan))
    refused(PhysicsError, "NaN", whole, X)
    whole.function = None  # the good rows are remembered
    assert whole(X[[0, 2]]).flatten().tolist() == [2.0, 3.0]


# Parallel calls


def test_handles_and_lambdas_are_copied():
    """A handle, such as a lock, cannot be pickled or copied."""
    physics, X = BlackBoxPhysics(partial(locked, threading.Lock())), normal(3, 2)
    assert copy.deepcopy(torch.nn.ModuleList([physics]))[0] is physics
    assert torch.allclose(copy.copy(physics)(X), torch_waves(X))
    scale = 3.0
    loaded = pickle.loads(cloudpickle.dumps(BlackBoxPhysics(lambda X: scale * waves(X))))
    assert torch.allclose(loaded(X), 3.0 * torch_waves(X))


# The memo

integers_as_rows = st.lists(st.lists(st.integers(-2, 2), min_size=2, max_size=2), min_size=1)


@pytest.mark.parametrize("batched", [True, False])
@given(calls=st.lists(integers_as_rows, min_size=1, max_size=5))
def test_each_distinct_row_is_evaluated_once(batched, calls):
    asked = []

    def record(X):
        asked.extend(tuple(row) for row in np.atleast_2d(X).tolist())
        return X.sum(-1)

    physics = BlackBoxPhysics(record, batched=batched)
    for rows in calls:
        X = torch.tensor(rows, dtype=torch.float64)
        for _ in range(2):
            Y = physics(X)
            assert torch.equal(Y, X.sum(-1, keepdim=True))
            Y.zero_()  # a copy
    assert len(asked) == len({*asked}) == len({tuple(row) for rows in calls for row in rows})


def test_the_memo_is_dropped_when_state_or_dtype_changes():
    three = torch.tensor(3.0).double()
    for change in (
        lambda scale: scale.gain.data.fill_(3.0),
        lambda scale: scale.load_state_dict({"gain": three, "offset": 0 * three}),
        lambda scale: setattr(scale, "gain", torch.nn.Parameter(three.clone())),
        lambda scale: scale.offset.add_(1.0),
    ):
        scale, X = Scale(), normal(3, 1)
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


finite = st.floats(allow_nan=False, allow_infinity=False, width=64)


@given(a=st.lists(finite, min_size=3, max_size=3), b=st.lists(finite, min_size=3, max_size=3))
def test_keys_are_equal_exactly_when_rows_are(a, b):
    one, other, same = row_keys(torch.tensor([a, b, a], dtype=torch.float64))
    assert one == same
    assert (one == other) == (a == b)
    strided = torch.tensor([a, b], dtype=torch.float64).T
    assert row_keys(strided) == row_keys(strided.clone())


def test_threads_share_a_memo_that_overflows():
    memo = RowMemo(capacity=20)
    X = torch.arange(60, dtype=torch.float64).unsqueeze(-1)

    def ask(number):
        generator = torch.Generator().manual_seed(number)
        for _ in range(300):
            rows = X[torch.randint(60, (12,), generator=generator)]
            assert torch.equal(memo.recall(rows, torch.square), rows**2)
            assert len(memo) <= 20

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    with ThreadPoolExecutor(8) as pool:
        assert len([*pool.map(ask, range(8))]) == 8
    sys.setswitchinterval(interval)


def refuse(X):
    raise AssertionError(f"asked for {X.tolist()}")


def test_capacity_copies_and_pickles_of_the_memo():
    memo, double = RowMemo(capacity=3), partial(torch.mul, 2)
    old, new = torch.tensor([[0.0], [1.0]]), torch.tensor([[2.0], [3.0]])
    memo.recall(old, double)
    with torch.inference_mode():
        memo.recall(new, double)
    assert len(memo) == 2
    assert torch.equal(memo.recall(new, refuse).add_(1.0), 2 * new + 1)  # a copy
    assert torch.equal(memo.recall(new, refuse), 2 * new)
    refused(AssertionError, "asked for", memo.recall, old, refuse)
    memo.recall(torch.arange(9.0).unsqueeze(-1), double)
    assert len(memo) == 3
    for empty in (copy.deepcopy(memo), pickle.loads(pickle.dumps(memo))):
        assert (len(empty), empty.capacity) == (0, 3)


def test_forget_holds_for_rows_under_evaluation():
    rows, X = [], normal(3, 1)

    def simulate(X):
        rows.append(len(X))
        physics.forget()  # as another thread may
        return X

    physics = BlackBoxPhysics(simulate)
    for _ in range(2):
        assert torch.equal(physics(X), X)
    assert rows == [3, 3]
