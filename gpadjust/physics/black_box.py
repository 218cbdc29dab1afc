"""A NumPy function or simulator as physics: its memory, parallel calls and gradients."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from threading import Lock
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gpadjust.checks import check_choice, checked_number, checked_whole, real_array
from gpadjust.physics.base import Physics, name_of
from gpadjust.physics.error import PhysicsError, described
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown

NumpyFunction = Callable[..., ArrayLike]
Array = NDArray[np.float64]


class BlackBoxPhysics(Physics):
    """Physics given as a NumPy function or a simulator.

    Simulations of single rows (``batched=False``) run in parallel inside ``with
    joblib.parallel_config(backend="loky", n_jobs=4)``, or any other backend of joblib, a cluster's
    included.

    Each distinct row is evaluated once, and its result remembered, even when other rows fail. The
    memory is dropped when a parameter or buffer of the physics changes, or dtype and device of the
    inputs; it cannot see other changes, such as a plain attribute: call ``forget()`` after those.
    Copies and pickles begin without it. Threads may share a physics if what it calls allows that.

    Args:
        function: Maps a float64 array of rows ``N x d`` to ``N x m``, or ``N`` if ``m`` is 1; with
            ``batched=False``, one row ``(d,)`` to ``(m,)`` or a scalar.
        unknowns: Unknown parameters by name; their values are then the function's second argument,
            ``p.mass`` or ``p["mass"]``, ``N`` each, or with ``batched=False`` a number. They are
            learnt by finite differences.
        batched: Whether the function takes all rows at once.
        gradient: ``"finite-difference"``: central differences give the gradient in X, by ``2 d``
            evaluations per row in the backward pass, which the memo does not keep. Second
            derivatives are not available. None: the outputs are constants to autograd.
        fd_step: The step of the finite differences in the units of X. Default:
            ``eps^(1/3) max(1, |x|)``.
        inputs: The columns of X that the function reads. Default: all.
        memo: The most rows to remember.
        name: The name in messages. Default: the function's.

    Raises:
        TypeError: If ``function`` is not callable, or a setting is not a number.
        ValueError: If a setting is not one of the above.

    Example:
        >>> physics = BlackBoxPhysics(lambda x: np.sin(x[0]) * x[1], batched=False)
        >>> X = torch.tensor([[0.0, 2.0]], dtype=torch.float64, requires_grad=True)
        >>> physics(X).sum().backward()
        >>> X.grad
        tensor([[2.0000, 0.0000]], dtype=torch.float64)
    """

    def __init__(
        self,
        function: NumpyFunction,
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        batched: bool = True,
        gradient: Literal["finite-difference"] | None = "finite-difference",
        fd_step: float | None = None,
        inputs: Sequence[int] | None = None,
        memo: int = 100_000,
        name: str | None = None,
    ) -> None:
        super().__init__(unknowns=unknowns, inputs=inputs, name=name_of(function, name))
        check_choice("gradient", gradient, ("finite-difference", None))
        if fd_step is not None:
            checked_number("fd_step", fd_step, above=0)
        self._memo = RowMemo(checked_whole("memo", memo, 0))
        self._remembered_for: list[Any] = []
        self.function = function
        self.batched = batched
        self.gradient = gradient
        self.fd_step = fd_step

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the function's outputs, as :meth:`Physics.evaluate`.

        Raises:
            PhysicsError: If single rows fail. It contains the outputs of the others.
        """
        x, *more = self._arrays(X, *parameters)
        if self.batched:
            return torch.from_numpy(real_array(self.function(x, *more))).to(X.device)
        from joblib import Parallel, delayed  # slow to import

        rows = ([x[i], *(ParameterValues(p, p.rows[i]) for p in more)] for i in range(len(x)))
        results = Parallel()(delayed(_call_row)(self.function, *row) for row in rows)
        outputs = [y for y in results if not isinstance(y, Exception)]
        Y = np.full((len(x), len(outputs[0]) if outputs else 1), np.nan)
        errors: dict[int, Exception] = {}
        for i, y in enumerate(results):
            if isinstance(y, Exception):
                errors[i] = y
            elif len(y) != Y.shape[1]:
                errors[i] = ValueError(f"found {len(y)} output(s), expected {Y.shape[1]} as before")
            else:
                Y[i] = y
        if errors:
            first = next(iter(errors.values()))
            raise PhysicsError(
                f"Physics {self.name!r} raised {described(first)}, in the first of {len(errors)} "
                f"failed row(s) of {len(x)}. Correct it, or exclude such inputs:",
                errors,
                partial=torch.from_numpy(Y) if outputs else None,
            ) from first
        return torch.from_numpy(Y).to(X.device)

    def of_rows(self, rows: Tensor) -> Tensor:
        """Return the outputs of rows from the memory, with the gradient that was chosen."""
        if self.gradient is None or not (torch.is_grad_enabled() and rows.requires_grad):
            return self._recall(rows.detach())
        return ExternalCall.apply(rows, self._recall, self._slope)

    def forget(self) -> None:
        """Empty the memory; call it after a change that the physics cannot see."""
        # A new memo: what other threads are evaluating right now ends in the old one.
        self._memo = RowMemo(self._memo.capacity)

    def _recall(self, rows: Tensor) -> Tensor:
        """Return ``N x m`` outputs, from the memory where it has them."""
        tensors = [*self.parameters(), *self.buffers()]
        # Values are compared, not versions: `p.data.fill_(...)` leaves a tensor's version as it is.
        state = [rows.dtype, rows.device, *(tensor.tolist() for tensor in tensors)]
        if self._remembered_for != state:
            self._remembered_for = state
            self.forget()
        return self._memo.recall(rows, super().of_rows)

    def _slope(self, rows: Tensor) -> Tensor:
        """Return the Jacobian, ``N x m x (d + p)``."""
        return self.jacobian(rows.double().cpu(), self.fd_step).to(rows)

    def _arrays(self, X: Tensor, *parameters: ParameterValues) -> list[Any]:
        """Return rows and parameters as arrays, copies to which a simulator may write."""
        x, *values = (
            tensor.detach().cpu().double().numpy().copy()
            for tensor in (X, *(p.rows for p in parameters))
        )
        return [x, *(ParameterValues(self.unknowns, rows) for rows in values)]


class RowMemo:
    """A dictionary of at most ``capacity`` input rows to output rows, which threads may share.

    When new rows do not fit, it forgets all and begins again with these. Rows that two threads ask
    for at the same moment may be evaluated by both. Copies and pickles of it are empty.

    Example:
        >>> memo = RowMemo(capacity=100)
        >>> def square(X):
        ...     print(f"{len(X)} new row(s)")
        ...     return X**2
        >>> memo.recall(torch.tensor([[2.0], [2.0]]), square)
        1 new row(s)
        tensor([[4.],
                [4.]])
        >>> memo.recall(torch.tensor([[2.0]]), square)
        tensor([[4.]])
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._rows: dict[bytes, Tensor] = {}
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._rows)

    def __reduce__(self) -> tuple[type[RowMemo], tuple[int]]:
        return RowMemo, (self.capacity,)

    def recall(
        self, rows: Tensor, evaluate: Callable[[Tensor], Tensor], learn: bool = True
    ) -> Tensor:
        """Return the values of some rows, of which a function computes those not remembered.

        Args:
            rows: ``N x d``.
            evaluate: Maps the distinct unknown rows ``k x d`` to values ``k x m``. If it raises a
                ``PhysicsError``, the finite rows of its ``partial`` result are remembered, and its
                ``rows`` restated.
            learn: Whether new values are remembered.
        """
        keys, known = row_keys(rows), self._rows  # to which other threads only add
        places: dict[bytes, int] = {}
        for i, key in enumerate(keys):
            if key not in known:
                places.setdefault(key, i)
        if not keys or not places:
            return torch.stack([known[key] for key in keys]).to(rows) if keys else evaluate(rows)
        new = [*places]
        try:
            values = evaluate(rows[[*places.values()]])
        except PhysicsError as error:
            if error.partial is not None and learn:
                good = error.partial.isfinite().all(-1)
                self.store([new[i] for i in good.nonzero()], error.partial[good])
            error.partial = None
            if error.inputs is None:
                failed = {new[i] for i in error.rows}
                error.rows = tuple(i for i, key in enumerate(keys) if key in failed)
            raise
        if learn:
            self.store(new, values)
        found = dict(zip(new, values, strict=True))
        return torch.stack([found[k] if k in found else known[k] for k in keys]).to(rows)

    def store(self, keys: list[bytes], values: Tensor) -> None:
        """Remember values ``N x m``, without an autograd graph, by distinct keys."""
        values = values.detach().clone()
        with self._lock:
            if len(self._rows) + len(keys) > self.capacity:
                self._rows = {}
            self._rows.update(zip(keys[: self.capacity], values[: self.capacity], strict=True))


def row_keys(rows: Tensor) -> list[bytes]:
    """Return a hashable key of each of ``N x d`` rows; those of equal rows alone are equal."""
    # Adding zero turns -0.0 into 0.0: they are equal, but their bytes are not.
    table = np.ascontiguousarray(rows.detach().cpu().double().numpy() + 0.0)
    row_bytes = np.dtype((np.void, table.itemsize * table.shape[1]))
    return cast(list[bytes], table.view(row_bytes).ravel().tolist())


class ExternalCall(torch.autograd.Function):
    """A function of rows whose Jacobian is computed elsewhere, when the backward pass needs it.

    Call ``ExternalCall.apply(X, value, jacobian)``: X is ``N x d``, ``value(X)`` is ``N x m`` and
    ``jacobian(X)`` is ``N x m x d``. A second derivative raises a ``NotImplementedError``.

    Example:
        >>> X = torch.tensor([[3.0]], requires_grad=True)
        >>> Y = ExternalCall.apply(X, lambda X: X**2, lambda X: 2 * X.unsqueeze(-1))
        >>> torch.autograd.grad(Y.sum(), X)
        (tensor([[6.]]),)
    """

    @staticmethod
    def forward(
        ctx: Any, X: Tensor, value: Callable[[Tensor], Tensor], jacobian: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Return the values, ``N x m``."""
        ctx.save_for_backward(X)
        ctx.jacobian = jacobian
        return value(X.detach())

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient in X, ``N x d``."""
        if torch.is_grad_enabled():  # by create_graph=True
            raise NotImplementedError(
                "A physics by finite differences has first derivatives only; for second ones write "
                "it in torch, as FunctionPhysics."
            )
        (X,) = ctx.saved_tensors
        return torch.einsum("nm,nmd->nd", grad, ctx.jacobian(X)), None, None


def _call_row(function: NumpyFunction, *row: Any) -> Array | Exception:
    """Return a function's outputs ``(m,)`` at a row, or the exception that it raises."""
    try:
        y = np.atleast_1d(real_array(function(*row)))
        if y.ndim > 1:
            raise ValueError(f"expected a scalar or outputs of shape (m,), found {y.shape}")
        return y
    except Exception as error:
        try:  # one that does not survive a pickle would break the pool, and lose the other rows
            pickle.loads(pickle.dumps(error))
        except Exception:
            return RuntimeError(f"{type(error).__name__}: {error}")
        return error
