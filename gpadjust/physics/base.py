"""The interface of a physics, and the code that all of them share."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import deepcopy
from operator import index
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gpadjust.physics.error import PhysicsError, described
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import Unknown, Unknowns

_NONE = Unknowns({})
# By a part of an error's message, the way out.
_HINTS = {
    "positional argument": " It is called with rows N x d and, if it has unknown parameters, named "
    "as unknowns={'mass': Unknown(...)}, with their values p, such as p.mass, one for each row.",
    "Can't call numpy()": " Wrap NumPy code as BlackBoxPhysics(function).",
}


class Physics(torch.nn.Module, ABC):
    r"""The crude model :math:`f_p : \mathbb{R}^d \to \mathbb{R}^m` of a system.

    A subclass computes the outputs of some rows in ``evaluate``; calling the physics adds batch
    shapes, the choice of columns, and checks. It must be deterministic.

    A model learns the ``unknowns`` by :func:`gpadjust.fit`; other fits leave them at the guesses. A
    deep copy of a physics without parameters and buffers is the physics itself, so that a
    simulator's handle outlives the copies that GP libraries make of their models.

    Args:
        unknowns: The unknown parameters by name, such as ``{"mass": Unknown(1.0, factor=1.5)}``.
        inputs: The columns of X that the physics reads, in its order; negative ones count from
            the end. Default: all.
        name: The name in messages. Default: the class's.

    Attributes:
        num_outputs: ``m``; None until the first call if it is not known before.
        unknowns: The unknown parameters, ``p`` of them.

    Raises:
        TypeError: If ``inputs`` are not whole numbers.
        ValueError: If ``inputs`` is empty.

    Example:
        >>> class Drag(Physics):
        ...     def evaluate(self, X):
        ...         return -0.5 * X * X.abs()
        >>> drag = Drag(inputs=[-1])
        >>> drag(torch.tensor([[7.0, 1.0], [7.0, 2.0]]))
        tensor([[-0.5000],
                [-2.0000]])
    """

    def __init__(
        self,
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        super().__init__()
        self.unknowns = _NONE if unknowns is None else Unknowns(unknowns)
        self.name = type(self).__name__ if name is None else name
        self.num_outputs: int | None = None
        self._has_warned = False
        try:
            self.inputs = None if inputs is None else tuple(map(index, inputs))
        except TypeError:
            raise TypeError(
                f"inputs must be a sequence of column numbers, such as [0, 2]; found {inputs!r}."
            ) from None
        if self.inputs == ():
            raise ValueError("inputs is empty; name at least one column of X, or None for all.")

    @abstractmethod
    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the outputs of some rows, without checks.

        Args:
            X: ``N x d``, the columns ``inputs`` only, ``N >= 1``.
            parameters: One argument if there are unknown parameters, their values by name, ``N``
                each: ``p.mass`` or ``p["mass"]``. None otherwise.

        Returns:
            ``N x m`` outputs, or ``N`` if ``m`` is 1.
        """

    def forward(self, X: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return the outputs of the physics.

        Args:
            X: ``batch_shape x n x d``, floating point.
            parameters: Values of the unknown parameters, ``... x p``, which broadcast with the
                batch shape. Default: the guesses.

        Returns:
            ``batch_shape x n x m``, of X's dtype. Dimensions along which X is expanded (stride 0)
            are evaluated once; the gradient is then right for the tensor that was expanded.

        Raises:
            TypeError: If X is not a floating-point tensor.
            ValueError: If X lacks a dimension or column, or parameters are of another shape.
            PhysicsError: If the physics fails, or returns something else than finite outputs.
        """
        columns = self.read(X)
        # Of the copies of an expanded leaf, each has a gradient of its own.
        for dim in range(0 if X.requires_grad and X.is_leaf else X.dim() - 1):
            if X.stride(dim) == 0:
                columns = columns.narrow(dim, 0, min(1, X.shape[dim]))
        if self.unknowns or parameters is not None:
            columns = self._with_parameters(columns, parameters)
        shape = np.broadcast_shapes(X.shape[:-1], columns.shape[:-1])
        rows = columns.flatten(0, -2)
        try:
            Y = self.of_rows(rows)
        except PhysicsError as error:
            if error.inputs is None:  # those of a physics that is called by this one are set
                number = torch.arange(len(rows)).reshape(columns.shape[:-1]).expand(shape).flatten()
                failed = {*error.rows}
                error.rows = tuple(i for i, row in enumerate(number.tolist()) if row in failed)
                error.inputs = rows.detach()[number[[*error.rows]]]
            raise
        is_cut = rows.requires_grad and torch.is_grad_enabled() and not Y.requires_grad
        if is_cut and len(Y) and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"No gradient flows through physics {self.name!r}: X requires grad, its outputs do "
                "not. Use BlackBoxPhysics(function, gradient='finite-difference'), or optimise "
                "acquisition functions with optimize_acqf(..., options={'with_grad': False}); "
                "ignore this if the outputs do not depend on X.",
                UserWarning,
                stacklevel=2,
            )
        return Y.reshape(*columns.shape[:-1], Y.shape[-1]).expand(*shape, -1)

    def or_nan(self, X: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return the outputs without gradient, NaN in rows at which the physics fails.

        Args:
            X: ``batch_shape x n x d``, floating point.
            parameters: As of :meth:`forward`.

        Raises:
            PhysicsError: If it does not contain the rows that failed, or if all do before the
                number of outputs is known.
        """
        with torch.no_grad():
            columns = self._with_parameters(self.read(X), parameters)
            blocks = columns.flatten(0, -2).unsqueeze(0)
            results = [self._where_it_works(blocks[0])]
            if isinstance(results[0], PhysicsError):
                # A function of all rows may raise an error because of some parameters.
                blocks = columns.reshape(-1, *columns.shape[-2:])
                results = [self._where_it_works(block) for block in blocks]
            if self.num_outputs is None:
                raise next(each for each in results if isinstance(each, PhysicsError))
            failed = columns.new_full((blocks.shape[1], self.num_outputs), torch.nan)
            Y = torch.cat([failed if isinstance(each, PhysicsError) else each for each in results])
            Y = Y.where(Y.isfinite().all(-1, keepdim=True), torch.nan)
        return Y.reshape(*columns.shape[:-1], self.num_outputs)

    def jacobian(self, rows: Tensor, step: float | None = None) -> Tensor:
        r"""Return the Jacobian by central differences in X, in one call of the physics.

        .. math:: \frac{\partial f_k}{\partial x_j} \approx
            \frac{f_k(x + h_j e_j) - f_k(x - h_j e_j)}{2 h_j}

        Args:
            rows: ``N x (d + p)``, columns of X and parameters.
            step: :math:`h`, in the columns' units. Default:
                :math:`\epsilon^{1/3} \max(1, |x|)`.

        Returns:
            ``N x m x (d + p)``, zero by the parameters.

        Raises:
            PhysicsError: If the physics fails; it names the rows around which it does.
        """
        p = len(self.unknowns)
        X = rows[:, : rows.shape[1] - p]
        n, d = X.shape
        h = torch.finfo(X.dtype).eps ** (1 / 3) * X.abs().clamp(min=1.0)
        h = h if step is None else torch.full_like(X, step)
        moves = pad(torch.diag_embed(h), (0, p))
        sides = torch.stack([rows.unsqueeze(1) + moves, rows.unsqueeze(1) - moves])  # 2 x n x d x .
        try:
            Y = self.fresh_rows(sides.flatten(0, 2))
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
        # The distance that rounding left, not 2 h.
        width = (sides[0] - sides[1]).diagonal(dim1=-2, dim2=-1)
        return pad(((upper - lower) / width.unsqueeze(-1)).mT, (0, p))

    def read(self, X: Tensor) -> Tensor:
        """Return the columns of ``X`` (``... x n x d``) that the physics reads, checked."""
        if not torch.is_tensor(X) or not X.is_floating_point():
            found = X.dtype if torch.is_tensor(X) else type(X).__name__
            raise TypeError(
                f"Physics {self.name!r} takes a floating-point tensor X; found {found}. Convert "
                "with torch.as_tensor(X, dtype=torch.float64)."
            )
        if X.dim() < 2 or X.shape[-1] == 0:
            raise ValueError(
                f"Physics {self.name!r} takes X of shape batch_shape x n x d; found "
                f"{tuple(X.shape)}. For a single point use X.unsqueeze(0)."
            )
        if self.inputs is None:
            return X
        d = X.shape[-1]
        absent = [i for i in self.inputs if not -d <= i < d]
        if absent:
            raise ValueError(
                f"Physics {self.name!r} reads the columns inputs={self.inputs}, but X of shape "
                f"{tuple(X.shape)} has no column {absent}. Pass all, or correct inputs."
            )
        return X[..., list(self.inputs)]

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if the physics names its columns, and data have them otherwise."""

    def read_rows(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return rows for :meth:`of_rows`, of rows ``N x d`` and parameters, others' too."""
        own = [parameters[0][name].unsqueeze(-1) for name in self.unknowns]
        return torch.cat([self.read(X), *own], dim=-1)

    def of_rows(self, rows: Tensor) -> Tensor:
        """Return the outputs ``N x m`` of rows ``N x (d + p)``: columns and parameters.

        The rows that an error names are these. Subclasses with a memory use it here.
        """
        if len(rows):
            return Physics.fresh_rows(self, rows)  # not a subclass's, which may skip evaluate
        if self.num_outputs is None:
            raise PhysicsError(
                f"Physics {self.name!r} was given no rows before its number of outputs was known; "
                "call it on at least one row first."
            )
        return rows.new_empty(0, self.num_outputs)

    def fresh_rows(self, rows: Tensor) -> Tensor:
        """Return :meth:`of_rows` without the memory, checked, in the dtype of the rows."""
        n = len(rows)
        try:
            Y = self.evaluate(*(self._arguments(rows) if self.unknowns else (rows,)))
        except PhysicsError as error:
            if error.partial is not None:
                error.partial = self._shaped(error.partial, n).to(rows)
            raise
        except Exception as error:
            hint = "".join(hint for part, hint in _HINTS.items() if part in str(error))
            raise PhysicsError(
                f"Physics {self.name!r} raised {described(error)}.{hint} The call was for {n} "
                "row(s):",
                range(n),
            ) from error
        Y = self._shaped(Y, n).to(rows)
        # A finite sum has finite terms only, and is the faster look.
        if not Y.detach().sum().isfinite():
            bad = (~Y.isfinite().all(-1)).nonzero().flatten().tolist()
            if bad:
                raise PhysicsError(
                    f"Physics {self.name!r} returned NaN or inf in {len(bad)} of {n} row(s), "
                    "expected finite numbers. Correct it, or exclude such inputs:",
                    bad,
                    partial=Y.detach(),
                )
        return Y

    def forget(self) -> None:
        """Empty the memory of evaluated rows, if there is one."""

    def extra_repr(self) -> str:
        """Return the settings that ``repr`` shows."""
        text = f"name={self.name!r}, inputs={self.inputs}, num_outputs={self.num_outputs}"
        return f"{text}, unknowns={dict(self.unknowns)!r}" if self.unknowns else text

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return the physics itself if it has no parameters and buffers, else a copy."""
        if not [*self.parameters(), *self.buffers()]:
            return self
        copy = type(self).__new__(type(self))
        memo[id(self)] = copy
        copy.__dict__.update(deepcopy(self.__dict__, memo))
        return copy

    def _arguments(self, rows: Tensor) -> tuple[Tensor, *tuple[ParameterValues, ...]]:
        """Return the arguments of :meth:`evaluate`, of rows ``N x (d + p)``."""
        d = rows.shape[-1] - len(self.unknowns)
        values = ParameterValues(self.unknowns, rows[:, d:])
        return (rows[:, :d], values) if self.unknowns else (rows,)

    def _with_parameters(self, columns: Tensor, parameters: Tensor | None) -> Tensor:
        """Return ``... x n x (d + p)``, with parameters ``... x p`` at the end of each row."""
        p = len(self.unknowns)
        values = self.unknowns.guess if parameters is None else parameters
        if not torch.is_tensor(values) or values.shape[-1:] != (p,) or (not p and values.numel()):
            found = tuple(values.shape) if torch.is_tensor(values) else repr(values)
            raise ValueError(
                f"Physics {self.name!r} has {p} unknown parameter(s) {', '.join(self.unknowns)}; "
                f"expected parameters of shape ... x {p}, found {found}."
            )
        batch = np.broadcast_shapes(columns.shape[:-2], values.shape[:-1])
        columns = columns.expand(*batch, *columns.shape[-2:])
        values = values.to(columns).unsqueeze(-2).expand(*columns.shape[:-1], p)
        return torch.cat([columns, values], dim=-1)

    def _where_it_works(self, rows: Tensor) -> Tensor | PhysicsError:
        """Return ``N x m`` outputs, not finite where the physics fails, or an error of all rows."""
        try:
            return self.fresh_rows(rows)
        except PhysicsError as error:
            if error.partial is not None:
                return error.partial
            if not error.rows:
                raise
            works = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
            works[[*error.rows]] = False
            results = self._where_it_works(rows[works]) if works.any() else error
        if isinstance(results, PhysicsError):
            return results
        Y = results.new_full((len(rows), results.shape[1]), torch.nan)
        Y[works] = results
        return Y

    def _shaped(self, Y: Tensor, n: int) -> Tensor:
        """Return outputs as ``n x m``; a PhysicsError unless they are that or ``n``."""
        is_real = torch.is_tensor(Y) and not Y.is_complex()
        if not is_real or Y.dim() not in (1, 2) or len(Y) != n or Y.shape[-1] == 0:
            found: object = type(Y).__name__
            if torch.is_tensor(Y):
                found = f"shape {tuple(Y.shape)}" if is_real else Y.dtype
            raise PhysicsError(
                f"Physics {self.name!r} returned {found}, expected a real tensor of shape ({n}, m) "
                f"or ({n},), one row per row of X. For a constant return X.new_full((len(X),), "
                "value); for NumPy code take BlackBoxPhysics(function), for a function of a single "
                "row BlackBoxPhysics(function, batched=False)."
            )
        Y = Y.unsqueeze(-1) if Y.dim() == 1 else Y
        if self.num_outputs is None:
            self.num_outputs = Y.shape[1]
        if self.num_outputs != Y.shape[1]:
            raise PhysicsError(
                f"Physics {self.name!r} returned {Y.shape[1]} output(s), expected "
                f"{self.num_outputs} as before; the number must not depend on the rows."
            )
        return Y


def name_of(function: Any, name: str | None, argument: str = "function") -> str:
    """Return a name, by default a function's; a TypeError unless the function is callable."""
    if not callable(function):
        raise TypeError(f"{argument} must be callable; found {type(function).__name__}.")
    return name or str(getattr(function, "__name__", type(function).__name__))
