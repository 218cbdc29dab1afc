"""A NumPy function or simulator as physics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gpadjust.checks import checked_whole, real_array
from gpadjust.physics.base import Physics
from gpadjust.physics.error import PhysicsError, described
from gpadjust.physics.gradient import ExternalCall
from gpadjust.physics.memo import RowMemo
from gpadjust.physics.row_calls import call_rows
from gpadjust.physics.unknown import ParameterValues, Unknown

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
    Threads may share a physics if what it calls allows that.

    Args:
        function: Maps a float64 array of rows ``N x d`` to ``N x m``, or ``N`` if ``m`` is 1; with
            ``batched=False``, one row ``(d,)`` to ``(m,)`` or a scalar.
        unknowns: Unknown parameters by name; their values are then the function's second argument,
            ``p.mass`` or ``p["mass"]``, ``N`` each, or with ``batched=False`` a number. They are
            learnt by finite differences.
        batched: Whether the function takes all rows at once.
        gradient: Where the gradient in X comes from. ``"finite-difference"``: central differences,
            ``2 d`` evaluations per row in the backward pass, which the memo does not keep. A
            callable: the Jacobian, from rows ``N x d`` (and parameters) to ``N x m x d``. None: no
            gradient, the outputs are constants to autograd. Second derivatives are not available.
        fd_step: The step of the finite differences in the units of X, one for all columns or one
            for each. Default: ``eps^(1/3) max(1, |x|)``.
        inputs: The columns of X that the function reads. Default: all.
        memo: The most rows to remember; 0 switches the memo off.
        name: The name in messages. Default: the function's.

    Raises:
        TypeError: If ``function`` is not callable.
        ValueError: If ``gradient`` or ``fd_step`` is none of the above.

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
        gradient: Literal["finite-difference"] | NumpyFunction | None = "finite-difference",
        fd_step: float | Sequence[float] | None = None,
        inputs: Sequence[int] | None = None,
        memo: int = 100_000,
        name: str | None = None,
    ) -> None:
        if not callable(function):
            raise TypeError(f"function must be callable; found {type(function).__name__}.")
        if not (gradient is None or gradient == "finite-difference" or callable(gradient)):
            raise ValueError(
                "gradient must be 'finite-difference', a callable that returns the Jacobian "
                f"N x m x d, or None for no gradient; found {gradient!r}."
            )
        steps = np.array(1.0 if fd_step is None else fd_step)
        if steps.size == 0 or not (np.isfinite(steps) & (steps > 0)).all():
            raise ValueError(f"fd_step must be positive, in the units of X; found {fd_step}.")
        name = name or getattr(function, "__name__", type(function).__name__)
        checked_whole("memo", memo, 0)
        super().__init__(unknowns=unknowns, inputs=inputs, name=name)
        self._memo, self._remembered_for = RowMemo(memo), list[Tensor]()
        self.function = function
        self.batched = batched
        self.gradient = gradient
        self.fd_step = fd_step

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """The function's outputs, as :meth:`Physics.evaluate`.

        Raises:
            PhysicsError: If single rows fail. It carries the outputs of the others.
        """
        rows, more = _to_numpy(X), [p.numpy() for p in parameters]
        Y = real_array(self.function(rows, *more)) if self.batched else self._stack(rows, *more)
        return torch.from_numpy(Y).to(X.device)

    def _stack(self, rows: Array, *parameters: ParameterValues) -> Array:
        more = ([p.row(i) for i in range(len(rows))] for p in parameters)
        results = call_rows(self.function, rows, *more)
        errors = {i: y for i, y in enumerate(results) if isinstance(y, Exception)}
        outputs = {i: y for i, y in enumerate(results) if not isinstance(y, Exception)}
        lengths = {len(y) for y in outputs.values()}
        if len(lengths) > 1:
            m = len(next(iter(outputs.values())))
            raise PhysicsError(
                f"Physics {self.name!r} returned {m} output(s) for its first row, but another "
                "number elsewhere; expected the same for every row:",
                [i for i, y in outputs.items() if len(y) != m],
            )
        Y = np.full((len(rows), *lengths), np.nan)
        for i, y in outputs.items():
            Y[i] = y
        if errors:
            first = next(iter(errors.values()))
            raise PhysicsError(
                f"Physics {self.name!r} raised {described(first)}, in the first of {len(errors)} "
                f"failed row(s) of {len(rows)}. Correct it, or exclude such inputs:",
                errors,
                partial=torch.from_numpy(Y) if outputs else None,
            ) from first
        return Y

    def of_rows(self, rows: Tensor) -> Tensor:
        """Return the outputs of rows from the memory, with the gradient that was chosen."""
        if not torch.is_grad_enabled() or not rows.requires_grad or len(rows) == 0:
            return self._recall(rows.detach())
        if self.gradient is None:
            self._warn_once(
                f"No gradient flows through physics {self.name!r}, which has gradient=None, "
                "though X requires grad. Optimise acquisition functions with "
                "optimize_acqf(..., options={'with_grad': False}), or choose "
                "gradient='finite-difference'."
            )
            return self._recall(rows.detach())
        d = rows.shape[1] - self._p
        if self.fd_step is not None and np.size(self.fd_step) not in (1, d):
            raise ValueError(
                f"fd_step of physics {self.name!r} has {np.size(self.fd_step)} entries, expected "
                f"1 or {d}, one for each column that the function reads."
            )
        return ExternalCall.apply(rows, self._recall, self._slope)

    def forget(self) -> None:
        """Empty the memory; call it after a change that the physics cannot see."""
        # A new memo: what other threads are evaluating right now ends in the old one.
        self._memo = RowMemo(self._memo.capacity)

    def _recall(self, rows: Tensor) -> Tensor:
        """Return ``N x m`` outputs, from the memory where it has them."""
        if not self._memo.capacity or len(rows) == 0:
            return super().of_rows(rows)
        # Values are compared, not versions: `p.data.fill_(...)` leaves a tensor's version as it is.
        state = [*self.parameters(), *self.buffers(), rows.new_empty(0)]
        before = self._remembered_for
        if len(before) != len(state) or not all(map(_same, before, state)):
            self._remembered_for = [tensor.detach().clone() for tensor in state]
            self.forget()
        return self._memo.recall(rows, super().of_rows)

    def _slope(self, rows: Tensor) -> Tensor:
        """The Jacobian, ``N x m x (d + p)``."""
        if callable(self.gradient):
            return self._user_jacobian(self.gradient, rows)
        n, d = len(rows), rows.shape[1] - self._p
        step = None if self.fd_step is None else torch.tensor(self.fd_step, dtype=torch.float64)
        try:
            return self.jacobian(rows.double().cpu(), step)[1].to(rows)
        except PhysicsError as error:
            if error.inputs is None:
                error.rows = tuple(sorted({i // d % n for i in error.rows}))
                error.inputs = rows[list(error.rows)]
            error.add_note(
                "This was in the finite differences around these rows. Make fd_step smaller, or "
                "pass gradient=None or the Jacobian as gradient."
            )
            raise

    def _user_jacobian(self, gradient: NumpyFunction, rows: Tensor) -> Tensor:
        X, *parameters = self._arguments(rows)
        try:
            J = real_array(gradient(_to_numpy(X), *(p.numpy() for p in parameters)))
        except PhysicsError:
            raise
        except Exception as error:
            raise PhysicsError(
                f"The gradient of physics {self.name!r} raised {type(error).__name__}: {error}."
            ) from error
        expected = (len(rows), self.num_outputs, X.shape[1])
        if J.shape != expected or not np.isfinite(J).all():
            raise PhysicsError(
                f"The gradient of physics {self.name!r} returned a Jacobian of shape {J.shape}, "
                f"expected shape N x m x d = {expected} and finite numbers."
            )
        return torch.from_numpy(np.pad(J, ((0, 0), (0, 0), (0, self._p)))).to(rows)


def _same(a: Tensor, b: Tensor) -> bool:
    return a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)


def _to_numpy(X: Tensor) -> Array:
    # A copy: a simulator may write to its input.
    return X.detach().cpu().double().numpy().copy()
