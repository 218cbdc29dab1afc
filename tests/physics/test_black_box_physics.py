"""NumPy functions and simulators as physics."""

import copy
import os
import pickle
import threading
import warnings
from fractions import Fraction

import cloudpickle
import joblib
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gpadjust.physics import BlackBoxPhysics, PhysicsError, Unknown
from tests.systems import refused


def waves(X):
    """For rows or one row: `[sin(x_0) exp(x_1), x_0 x_1^2]`."""
    return np.stack([np.sin(X[..., 0]) * np.exp(X[..., 1]), X[..., 0] * X[..., 1] ** 2], -1)


def torch_waves(X):
    return torch.stack([X[..., 0].sin() * X[..., 1].exp(), X[..., 0] * X[..., 1] ** 2], -1)


class Handle:
    """A simulator that cannot be pickled or copied."""

    def __init__(self):
        self.lock = threading.Lock()

    def __call__(self, X):
        with self.lock:
            return waves(X)


class TestValues:
    @given(
        batch=st.lists(st.integers(1, 3), max_size=2), n=st.integers(1, 4), batched=st.booleans()
    )
    def test_any_batch_shape_gives_the_plain_function(self, batch, n, batched):
        X = torch.randn(*batch, n, 2, dtype=torch.float64)
        assert torch.allclose(BlackBoxPhysics(waves, batched=batched)(X), torch_waves(X))

    def test_function_sees_float64_columns(self):
        seen = []

        def record(X):
            seen.append(X)
            return X[:, 0]

        Y = BlackBoxPhysics(record, inputs=[1])(torch.tensor([[1.0, 2.0]], dtype=torch.float32))
        assert Y.dtype == torch.float32
        assert (seen[0].dtype, seen[0].tolist()) == (np.float64, [[2.0]])

    @pytest.mark.parametrize("batched", [True, False])
    def test_rows_are_the_functions_and_evaluated_once(self, batched, numpy_counter, points):
        buffer = np.zeros(1)

        def vandal(x):
            buffer[0] = x.flat[0]
            x[:] = 99.0
            return buffer

        X = torch.tensor([[1.0]], dtype=torch.float64)
        physics = BlackBoxPhysics(vandal, batched=batched)
        first = physics(X)
        physics(X + 1)
        assert X.item() == first.item() == 1.0
        physics = BlackBoxPhysics(numpy_counter, batched=batched)
        X = points(4, 2)
        physics(X.expand(3, 4, 2))
        physics(X.requires_grad_())
        physics(X[:2].repeat(2, 1))
        assert len(numpy_counter.rows) == 4


class TestGradients:
    @pytest.mark.parametrize("batched", [True, False])
    def test_agrees_with_autograd(self, batched, points):
        physics = BlackBoxPhysics(waves, batched=batched)
        X, weights = points(3, 4, 2).requires_grad_(), points(3, 4, 2, seed=1)
        (found,) = torch.autograd.grad((weights * physics(X)).sum(), X)
        (expected,) = torch.autograd.grad((weights * torch_waves(X)).sum(), X)
        assert torch.allclose(found, expected, rtol=1e-7, atol=1e-8)
        assert torch.autograd.gradcheck(physics, X)

    def test_repeated_rows_and_the_memo(self, numpy_counter, points):
        physics = BlackBoxPhysics(numpy_counter)
        x = points(1, 2).requires_grad_()
        physics(x.expand(3, 1, 2)).sum().backward()
        once = x.grad.clone()
        assert len(numpy_counter.rows) == 1 + 4
        x.grad = None
        physics(x.repeat(3, 1)).sum().backward()
        assert torch.allclose(x.grad, once)
        expected = 3 * (2 * x.detach() + torch.tensor([[1.0, 0.0]]) * x.detach().cos())
        assert torch.allclose(once, expected)
        numpy_counter.rows.clear()
        physics = BlackBoxPhysics(numpy_counter)
        for number in (1, 2):
            Y = physics(points(3, 2).requires_grad_())
            assert len(numpy_counter.rows) == 3 + (number - 1) * 2 * 2 * 3
            Y.sum().backward()
            assert len(numpy_counter.rows) == 3 + number * 2 * 2 * 3

    def test_step(self, numpy_counter):
        h = 0.5
        physics = BlackBoxPhysics(numpy_counter, fd_step=h)
        X = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
        physics(X).sum().backward()
        assert set(numpy_counter.rows[1:]) == {(h, 0), (-h, 0), (0, h), (0, -h)}

    def test_second_derivatives_and_none(self, points):
        X = points(3, 2).requires_grad_()
        Y = BlackBoxPhysics(waves)(X).sum() + (X**3).sum()
        with pytest.raises(NotImplementedError, match="first derivatives only"):
            torch.autograd.grad(Y, X, create_graph=True)
        physics = BlackBoxPhysics(waves, gradient=None, name="mill")
        X = points(3, 2).requires_grad_()
        with pytest.warns(UserWarning, match=r"No gradient.*'mill'.*'with_grad': False"):
            assert not physics(X).requires_grad
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert torch.allclose(physics(X), torch_waves(X))

    def test_failure_in_finite_differences_names_the_row(self):
        physics = BlackBoxPhysics(np.sqrt)
        X = torch.tensor([[4.0, 1.0], [0.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
        X.requires_grad_()
        Y = physics(X)
        with (
            np.errstate(invalid="ignore"),
            pytest.raises(PhysicsError, match=r"(?s)NaN or inf.*row 1: \[0.0, 1.0\]") as caught,
        ):
            Y.sum().backward()
        assert caught.value.rows == (1,)
        assert "step smaller" in caught.value.__notes__[0]


def test_bad_settings():
    for gradient in ("autograd", 1, waves):
        refused(ValueError, "Unknown gradient", BlackBoxPhysics, waves, gradient=gradient)
    for fd_step in (0.0, -1.0, float("nan")):
        says = "fd_step must be finite and above 0"
        refused(ValueError, says, BlackBoxPhysics, waves, fd_step=fd_step)
    refused(TypeError, "callable; found list", BlackBoxPhysics, [])


def test_wrong_results(points):
    for function, batched, says in (
        (lambda x: x[0] + x[1], True, r"single row, set batched=False"),
        (lambda x: np.zeros((2, 2)), False, r"a scalar or outputs.*found \(2, 2\)"),
        *(
            (lambda x, result=result: result, batched, f"expected real numbers, found {found}")
            for result, found in ((1j, "complex"), (None, "None"), ("1", "<U1"), ([None], "No"))
            for batched in (True, False)
        ),
    ):
        physics = BlackBoxPhysics(function, batched=batched, name="mill")
        refused(PhysicsError, rf"Physics 'mill' .*{says}", physics, points(3, 2))


def test_errors_do_not_advise_what_it_is(points):
    for function in (lambda X: X[0, 9], lambda X: 1.0):
        with pytest.raises(PhysicsError, match="set batched=False") as caught:
            BlackBoxPhysics(function)(points(3, 2))
        assert "BlackBoxPhysics" not in str(caught.value)


class TestFailures:
    def test_rows_of_different_length(self):
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
    def test_good_rows_survive_failed_ones(self, grad):
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


class TestParallel:
    def test_threads_share_the_rows(self, points):
        barrier = threading.Barrier(2, timeout=10)

        def simulate(x):
            barrier.wait()  # Only two calls at the same time get past this.
            return x[0]

        X = points(2, 2)
        physics = BlackBoxPhysics(simulate, batched=False)
        with joblib.parallel_config(backend="threading", n_jobs=2):
            assert torch.equal(physics(X), X[:, :1])

    @pytest.mark.slow
    def test_processes_share_the_rows(self):
        class UnpicklableError(Exception):
            def __init__(self, code, reason):
                super().__init__(f"{reason} ({code})")

        def simulate(x):
            if x[0] < 0:
                raise UnpicklableError(7, "diverged")
            return float(os.getpid())

        physics = BlackBoxPhysics(simulate, batched=False)
        X = torch.tensor([[1.0], [-1.0], [2.0], [3.0]], dtype=torch.float64)
        with (
            joblib.parallel_config(backend="loky", n_jobs=2),
            pytest.raises(PhysicsError, match=r"UnpicklableError: diverged \(7\)") as caught,
        ):
            physics(X)
        assert caught.value.rows == (1,)
        processes = physics(X[[0, 2, 3]])
        assert os.getpid() not in processes.flatten().tolist()


class TestCopies:
    def test_handles_and_lambdas_are_copied(self, points):
        physics = BlackBoxPhysics(Handle())
        assert copy.deepcopy(torch.nn.ModuleList([physics]))[0] is physics
        assert torch.allclose(copy.copy(physics)(points(3, 2)), torch_waves(points(3, 2)))
        scale = 3.0
        physics = BlackBoxPhysics(lambda X: scale * waves(X))
        loaded = pickle.loads(cloudpickle.dumps(physics))
        X = points(3, 2).requires_grad_()
        Y = loaded(X)
        assert torch.allclose(Y, 3.0 * torch_waves(X))
        (found,) = torch.autograd.grad(Y.sum(), X)
        (expected,) = torch.autograd.grad(3.0 * torch_waves(X).sum(), X)
        assert torch.allclose(found, expected)


UNKNOWNS = {"gain": Unknown(1.0, sd=1.0), "rate": Unknown(2.0, factor=1.5)}


class TestUnknownParameters:
    @staticmethod
    def decay(x, p):
        return p.gain * np.exp(-p.rate * x[..., 0]) * x[..., 1]

    @pytest.mark.parametrize("batched", [True, False])
    def test_gradient(self, batched, points):
        options = {"unknowns": UNKNOWNS, "batched": batched, "fd_step": 1e-5}
        X, values = points(2, 3, 2).requires_grad_(), points(2, 2, seed=1)
        found = BlackBoxPhysics(self.decay, **options)(X, values)
        gain, rate = values.unsqueeze(-2).unbind(-1)
        expected = (gain * (-rate * X[..., 0]).exp() * X[..., 1]).unsqueeze(-1)
        torch.testing.assert_close(found, expected)
        slopes = [torch.autograd.grad(Y.square().sum(), X)[0] for Y in (found, expected)]
        torch.testing.assert_close(*slopes, rtol=1e-6, atol=1e-6)

    def test_failure_in_finite_differences_names_the_row(self):
        physics = BlackBoxPhysics(lambda x, p: np.sqrt(x[:, 0] - p.gain), unknowns=UNKNOWNS)
        X = torch.tensor([[4.0], [1.0]], dtype=torch.float64).requires_grad_()
        Y = physics(X, torch.tensor([[0.0, 2.0], [1.0, 2.0]], dtype=torch.float64))
        with np.errstate(invalid="ignore"), pytest.raises(PhysicsError) as caught:
            Y.sum().backward()
        assert caught.value.rows == (3,)
        assert caught.value.inputs.tolist() == [[1.0, 1.0, 2.0]]


class TestDifferences:
    @staticmethod
    def slopes(function, X, step=None):
        """The gradient of the sum of the outputs in each row."""
        X = X.clone().requires_grad_()
        physics = BlackBoxPhysics(function, fd_step=step)
        return torch.autograd.grad(physics(X).sum(), X)[0]

    def test_they_are_exact_for_quadratics(self, points):
        X = points(6, 2)
        assert torch.allclose(self.slopes(np.square, X, 0.5), 2 * X, rtol=1e-12, atol=1e-12)

    def test_large_inputs_get_a_step_that_floats_can_tell_apart_counted_as_rounded(self):
        X = torch.tensor([[1e9]], dtype=torch.float64)
        assert torch.allclose(self.slopes(lambda X: 3 * X, X), torch.tensor(3.0).double())
        assert self.slopes(lambda X: X, X, 1.7e-7).item() == 1.0
