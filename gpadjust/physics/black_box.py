"""A NumPy function or simulator as physics: its memory, parallel calls and gradients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from threading import Lock
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torch.nn.functional import pad

from gpadjust.checks import check_choice, checked_number, real_array
from gpadjust.physics.base import Physics, name_of
from gpadjust.physics.error import PhysicsError, described
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown


class BlackBoxPhysics(Physics):
    """Physics given as a NumPy function or a simulator.

    Single rows (``batched=False``) run in parallel inside ``with
    joblib.parallel_config(backend="loky", n_jobs=4)``, or another backend of joblib, a cluster's.

    A call evaluates each distinct row once and remembers its result, even when other rows fail,
    until a parameter or buffer of the physics changes, or dtype and device of the inputs. Call
    ``forget()`` after other changes. Copies and pickles begin without this memory. Threads may
    share a physics if its function allows that.

    Args:
        function: Maps a float64 array of rows ``N x d`` to ``N x m``, or ``N`` if ``m`` is 1; with
            ``batched=False``, one row ``(d,)``, and a number for each unknown parameter, to
            ``(m,)`` or a scalar.
        batched: If True, the function takes all rows at once.
        gradient: ``"finite-difference"``: central differences give the gradient in X, without
            second derivatives, by ``2 d`` evaluations per row in the backward pass, which are not
            remembered. None: the outputs are constants to autograd.
        fd_step: The step of the differences in the units of X. Default: ``eps^(1/3) max(1, |x|)``.
        unknowns, inputs, name: As of :class:`Physics`.

    Example:
        >>> physics = BlackBoxPhysics(lambda x: np.sin(x[0]) * x[1], batched=False)
        >>> X = torch.tensor([[0.0, 2.0]], dtype=torch.float64, requires_grad=True)
        >>> physics(X).sum().backward()
        >>> X.grad
        tensor([[2.0000, 0.0000]], dtype=torch.float64)
    """

    advice = "If the function takes a single row, set batched=False."

    def __init__(
        self,
        function: Callable[..., ArrayLike],
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        batched: bool = True,
        gradient: Literal["finite-difference"] | None = "finite-difference",
        fd_step: float | None = None,
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        super().__init__(unknowns=unknowns, inputs=inputs, name=name_of(function, name))
        check_choice("gradient", gradient, ("finite-difference", None))
        if fd_step is not None:
            checked_number("fd_step", fd_step, above=0)
        self.function = function
        self.batched = batched
        self.gradient = gradient
        self.fd_step = fd_step
        self._remembered_for: list[Any] = []
        self.forget()

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the function's outputs; an error of single rows contains the other outputs."""
        rows = self._table(X, *parameters)
        if self.batched:
            return torch.from_numpy(real_array(self.function(*self._arguments(rows))))
        from joblib import Parallel, delayed  # slow to import

        call = delayed(call_row)
        results = Parallel()(call(self.function, *self._arguments(row)) for row in rows)
        return self._gathered(results)

    @staticmethod
    def _table(X: Tensor, *parameters: ParameterValues) -> NDArray[np.float64]:
        """Return rows ``N x (d + p)`` as an array, a copy, to which a simulator may write."""
        tensor = torch.cat([X, *(values.rows for values in parameters)], dim=-1)
        return tensor.detach().cpu().double().numpy()

    def _gathered(self, results: list[NDArray[np.float64] | PhysicsError]) -> Tensor:
        """Return the outputs of rows ``(m,)`` as ``N x m``; raise an error if some rows failed."""
        m = next((len(y) for y in results if isinstance(y, np.ndarray)), 1)
        Y = np.full((len(results), m), np.nan)  # NaN where a row fails
        errors = dict[int, PhysicsError]()
        for i, y in enumerate(results):
            if isinstance(y, PhysicsError):
                errors[i] = y
            elif len(y) != m:
                message = f"ValueError: found other than {m} output(s), as in other rows"
                errors[i] = PhysicsError(message)
            else:
                Y[i] = y
        if errors:
            first = next(iter(errors.values()))
            raise PhysicsError(
                f"Physics {self.name!r} raised {first}, in the first of {len(errors)} failed "
                f"row(s) of {len(results)}. Correct it, or exclude such inputs:",
                errors,
                partial=torch.from_numpy(Y) if len(errors) < len(results) else None,
            ) from first.__cause__
        return torch.from_numpy(Y)

    def of_rows(self, rows: Tensor) -> Tensor:
        """Return the outputs of rows from the memory, with the gradient of this physics."""
        tensors = [*self.parameters(), *self.buffers()]
        # Values are compared, not versions: `p.data.fill_(...)` leaves a tensor's version as it is.
        state = [rows.dtype, rows.device, *(tensor.tolist() for tensor in tensors)]
        if self._remembered_for != state:
            self._remembered_for = state
            self.forget()
        Y = self._memo.recall(rows.detach(), super().of_rows)
        if self.gradient is None or not (torch.is_grad_enabled() and rows.requires_grad):
            return Y
        return FiniteDifferences.apply(rows.double(), Y.double(), self, self.fd_step).to(rows)

    def forget(self) -> None:
        """Empty the memory; call it after a change that the physics cannot see."""
        # A new memo, so that rows which other threads are evaluating right now end in the old one.
        self._memo = RowMemo()


class RowMemo:
    """A dictionary of at most ``capacity`` input rows to output rows, which threads may share.

    When new rows do not fit, it forgets all and begins again with these. Copies are empty.
    """

    def __init__(self, capacity: int = 100_000) -> None:
        self.capacity = capacity
        self._rows: dict[bytes, Tensor] = {}
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._rows)

    def __reduce__(self) -> tuple[type[RowMemo], tuple[int]]:
        return RowMemo, (self.capacity,)

    def recall(self, rows: Tensor, evaluate: Callable[[Tensor], Tensor]) -> Tensor:
        """Return the values of rows ``N x d``, by a function of distinct rows if not remembered."""
        keys = row_keys(rows)
        if not keys:
            return evaluate(rows)  # which sets the number of outputs
        remembered = self._rows  # to which other threads only add
        outputs = {key: remembered[key] for key in keys if key in remembered}
        places = {key: i for i, key in enumerate(keys) if key not in outputs}
        if places:
            new = [*places]
            try:
                values = evaluate(rows[[*places.values()]])
            except PhysicsError as error:
                if error.partial is not None:  # rows that did not fail are remembered
                    good = error.partial.isfinite().all(-1)
                    self._store([new[i] for i in good.nonzero()], error.partial[good])
                error.partial = None  # it has the distinct rows alone
                if error.inputs is None:
                    failed = {new[i] for i in error.rows}
                    error.rows = tuple(i for i, key in enumerate(keys) if key in failed)
                raise
            self._store(new, values)
            outputs.update(zip(new, values, strict=True))
        return torch.stack([outputs[key] for key in keys]).to(rows)

    def _store(self, keys: list[bytes], values: Tensor) -> None:
        """Remember values ``N x m``, without an autograd graph, by distinct keys."""
        values = values.detach().clone()
        with self._lock:
            if len(self._rows) + len(keys) > self.capacity:
                self._rows = {}  # a new dictionary, as other threads may read the old one
            self._rows.update(zip(keys[: self.capacity], values[: self.capacity], strict=True))


def row_keys(rows: Tensor) -> list[bytes]:
    """Return a hashable key of each of ``N x d`` rows; those of equal rows alone are equal."""
    # Adding zero turns -0.0 into 0.0: they are equal, but their bytes are not.
    table = np.ascontiguousarray(rows.detach().cpu().double().numpy() + 0.0)
    row_bytes = np.dtype((np.void, table.itemsize * table.shape[1]))
    return cast(list[bytes], table.view(row_bytes).ravel().tolist())


class FiniteDifferences(torch.autograd.Function):
    r"""Outputs of a physics, with the gradient in X by central differences in the backward pass.

    .. math:: \frac{\partial f_k}{\partial x_j} \approx
        \frac{f_k(x + h_j e_j) - f_k(x - h_j e_j)}{2 h_j}

    ``FiniteDifferences.apply(rows, Y, physics, step)`` returns ``N x m`` outputs Y of the rows
    ``N x (d + p)``, columns of X and parameters; the gradient is 0 by the latter.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, Y: Tensor, physics: Physics, step: float | None) -> Tensor:
        """Return the outputs."""
        ctx.save_for_backward(rows)
        ctx.physics, ctx.step = physics, step
        return Y.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        """Return the gradient in the rows, by one call of the physics."""
        if torch.is_grad_enabled():  # by create_graph=True
            raise NotImplementedError(
                "Finite differences give first derivatives only; write the physics in torch, as "
                "FunctionPhysics, for second ones."
            )
        (rows,) = ctx.saved_tensors
        n = len(rows)
        p = len(ctx.physics.unknowns)
        d = rows.shape[1] - p
        # h = eps^(1/3) max(1, |x|) balances the errors of rounding and of truncation.
        h = torch.finfo(rows.dtype).eps ** (1 / 3) * rows.abs().clamp(min=1.0)
        if ctx.step is not None:
            h = torch.full_like(rows, ctx.step)
        moves = torch.diag_embed(h)[:, :d]
        sides = rows.unsqueeze(1) + torch.stack([moves, -moves])  # 2 x n x d x (d + p)
        try:
            Y = ctx.physics.fresh_rows(sides.flatten(0, 2))
        except PhysicsError as error:
            if error.inputs is None:
                error.rows = tuple(sorted({i // d % n for i in error.rows}))
                error.inputs = rows[[*error.rows]]
            error.add_note(
                "This was in the finite differences around these rows. Make their step smaller, or "
                "choose another gradient."
            )
            raise
        upper, lower = Y.unflatten(0, sides.shape[:3])
        # The distance after rounding, not 2 h.
        width = (sides[0] - sides[1]).diagonal(dim1=-2, dim2=-1)
        # df/dx_j = (f(x + h_j e_j) - f(x - h_j e_j)) / width_j
        slopes = (upper - lower) / width.unsqueeze(-1)  # n x d x m
        gradient = torch.einsum("nm,ndm->nd", grad, slopes)
        return pad(gradient, (0, p)), None, None, None


def call_row(function: Callable[..., ArrayLike], *row: Any) -> NDArray[np.float64] | PhysicsError:
    """Return a function's outputs ``(m,)`` at a row, or an error."""
    try:
        y = np.atleast_1d(real_array(function(*row)))
        if y.ndim > 1 or not len(y):
            raise ValueError(f"expected a scalar or outputs of shape (m,), found {y.shape}")
        return y
    except Exception as error:
        failure = PhysicsError(described(error))  # which survives a pickle, unlike some others
        failure.__cause__ = error
        return failure
