"""The interface of a physics, and the code that all of them share."""

from __future__ import annotations

import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from keyword import iskeyword
from typing import Any, Self
from unicodedata import normalize

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.physics.error import PhysicsError, described, outline
from gpadjust.physics.parameters import ParameterValues
from gpadjust.physics.unknown import NO_UNKNOWNS, Unknown, Unknowns


class Physics(torch.nn.Module, ABC):
    r"""The crude model :math:`f_p : \mathbb{R}^d \to \mathbb{R}^m` of a system.

    A subclass computes the outputs of rows in ``evaluate``; calling the physics adds batch shapes,
    the choice of columns, and checks. It must be deterministic. Wrong arguments raise a TypeError
    or ValueError, a failure a :class:`PhysicsError`.

    :func:`gpadjust.fit` fits the ``unknowns``, by draws or as a point; before, they are at the
    guesses. A deep copy of a physics without parameters and buffers is the physics itself, as GP
    libraries copy their models, and a simulator's handle cannot be copied.

    Args:
        unknowns: The ``p`` unknown parameters, such as ``{"mass": Unknown(1.0, factor=1.5)}``. The
            last argument of a function contains their values, ``p.mass`` or ``p["mass"]``.
        inputs: The columns of X to read, in order; negative ones from the end. Default: all.
        name: The name in messages. Default: the name of the function or class.

    Attributes:
        num_outputs: ``m``; None until the first call if it is not known before.
        step: Of a physics that returns the next state, the time until then; None if it is unknown.

    Example:
        >>> class Drag(Physics):
        ...     def evaluate(self, X):
        ...         return -0.5 * X * X.abs()
        >>> drag = Drag(inputs=[-1])
        >>> drag(torch.tensor([[7.0, 2.0]]))
        tensor([[-2.]])
    """

    advice: str = "NumPy code is BlackBoxPhysics(function), of a single row batched=False."
    """The last sentence of an error in ``evaluate``."""
    step: float | None = None
    column_names: Sequence[str] = ()  # of X, of a physics that names them

    def __init__(
        self,
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        super().__init__()
        self.unknowns = NO_UNKNOWNS if unknowns is None else Unknowns(unknowns)
        self.inputs: tuple[int, ...] | None = None
        if inputs is not None:
            self.inputs = tuple(checked_whole("inputs", column) for column in inputs)
        if self.inputs == ():
            raise ValueError("inputs is empty; name at least one column of X, or None for all.")
        self.name = name or type(self).__name__
        self.num_outputs: int | None = None
        self._has_warned = False

    @abstractmethod
    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the outputs of rows X, ``N x d``, as ``N x m``, or ``N`` if ``m`` is 1.

        X has the columns ``inputs`` only. If there are unknown parameters, there is one more
        argument, their values, ``N`` each.
        """

    def forward(self, X: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return the outputs of the physics, ``batch_shape x n x m``, of X's dtype.

        Dimensions along which X is expanded (stride 0) are evaluated once; the gradient is then
        right for the tensor that was expanded.

        Args:
            X: ``batch_shape x n x d``, floating point.
            parameters: Values of the unknown parameters, ``... x p``, which broadcast with the
                batch shape. Default: the guesses.
        """
        columns = self.read(X)
        # Each copy in an expanded leaf has its own gradient, so that these are all evaluated.
        for dim in range(0 if X.requires_grad and X.is_leaf else X.dim() - 1):
            if X.stride(dim) == 0:
                columns = columns.narrow(dim, 0, min(1, X.shape[dim]))
        if self.unknowns or parameters is not None:
            columns = self._with_parameters(columns, parameters)
        shape = np.broadcast_shapes(X.shape[:-1], columns.shape[:-1])  # batch_shape x n
        rows = columns.flatten(0, -2)  # N x (d + p)
        try:
            Y = self.of_rows(rows)
        except PhysicsError as error:
            if error.inputs is None:  # else the rows are those of a physics that this one calls
                # The row that was evaluated for each one of X, of which some may be copies.
                number = torch.arange(len(rows)).reshape(columns.shape[:-1]).expand(shape).flatten()
                failed = {*error.rows}
                error.rows = tuple(i for i, row in enumerate(number.tolist()) if row in failed)
                error.inputs = rows.detach()[number[[*error.rows]]]
            raise
        # The graph ends in the function, without which an optimiser would stay where it is.
        is_cut = rows.requires_grad and torch.is_grad_enabled() and not Y.requires_grad
        if is_cut and len(Y) and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"No gradient flows through physics {self.name!r}, although X requires it. Take "
                "BlackBoxPhysics(function, gradient='finite-difference'), or optimize_acqf(..., "
                "options={'with_grad': False}); ignore this if the outputs do not depend on X.",
                UserWarning,
                stacklevel=2,
            )
        return Y.reshape(*columns.shape[:-1], Y.shape[-1]).expand(*shape, -1)

    def or_nan(self, X: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return the outputs without gradient, NaN in rows at which the physics fails.

        Takes the arguments of :meth:`forward`. If its error has no ``partial`` result, all rows
        of the same ``parameters`` are NaN; one that names no rows, or occurs before the number of
        outputs is known, is raised.
        """
        columns = self._with_parameters(self.read(X), parameters)
        with torch.no_grad():
            Y = self._or_nan(columns)
        Y = Y.where(Y.isfinite().all(-1, keepdim=True), torch.nan)  # all outputs of a row, or none
        return Y.reshape(*columns.shape[:-1], Y.shape[-1])

    def read(self, X: Tensor) -> Tensor:
        """Return the columns of ``X`` (``... x n x d``) that the physics reads, checked."""
        is_floating = torch.is_tensor(X) and X.is_floating_point()
        d = X.shape[-1] if is_floating and X.dim() > 1 else 0
        if d == 0 or any(not -d <= i < d for i in self.inputs or ()):
            columns = ""
            if self.inputs is not None:
                columns = f", with the columns inputs={self.inputs}"
            raise (ValueError if is_floating else TypeError)(
                f"Physics {self.name!r} takes a floating-point tensor X of shape batch_shape x n x "
                f"d{columns}; found {outline(X)}. Convert with torch.as_tensor(X, dtype="
                "torch.float64); a single point is X.unsqueeze(0)."
            )
        return X if self.inputs is None else X[..., list(self.inputs)]

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if data have columns of these names in another order."""
        places = {name: i for i, name in enumerate(self.column_names)}
        if any(places.get(name, i) != i for i, name in enumerate(names)):
            raise ValueError(
                f"Physics {self.name!r} has the columns {', '.join(places)}, and the data have "
                f"{', '.join(names)}: give it the columns in the order of the data."
            )

    def read_rows(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return rows for :meth:`of_rows` of rows ``N x d`` and values that contain its own."""
        values = [parameters[0][name].unsqueeze(-1) for name in self.unknowns]
        return torch.cat([self.read(X), *values], dim=-1)

    def of_rows(self, rows: Tensor) -> Tensor:
        """Return the outputs ``N x m`` of rows ``N x (d + p)``, from a memory if there is one."""
        if len(rows) or self.num_outputs is None:
            return Physics.fresh_rows(self, rows)  # not a subclass's, which may skip evaluate
        return rows.new_empty(0, self.num_outputs)

    def fresh_rows(self, rows: Tensor) -> Tensor:
        """Return :meth:`of_rows` without the memory, checked, in the dtype of the rows."""
        n = len(rows)
        try:
            # Without parameters no frame for the arguments: f_p is called in loops.
            Y = self.evaluate(*(self._arguments(rows) if self.unknowns else (rows,)))
        except PhysicsError as error:
            if error.inputs is not None:  # those of a physics that this one calls
                error.partial = None
            if error.partial is not None:
                error.partial = self._shaped(error.partial, rows)
            raise
        except Exception as error:
            raise PhysicsError(
                f"Physics {self.name!r} raised {described(error)}. {self.advice} The call was for "
                f"{n} row(s), with unknowns={[*self.unknowns]}:",
                range(n),
            ) from error
        Y = self._shaped(Y, rows)
        bad = (~Y.isfinite().all(-1)).nonzero().flatten().tolist()
        if bad:
            raise PhysicsError(
                f"Physics {self.name!r} returned NaN or inf in {len(bad)} of {n} row(s), expected "
                "finite numbers. Correct it, or exclude such inputs:",
                bad,
                partial=Y.detach(),
            )
        return Y

    def forget(self) -> None:
        """Empty the memory of evaluated rows, if there is one."""

    def extra_repr(self) -> str:
        """Return the settings that ``repr`` shows."""
        return f"name={self.name!r}, inputs={self.inputs}, unknowns={self.unknowns.declared!r}"

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        if not [*self.parameters(), *self.buffers()]:
            return self  # nothing that a fit could change
        memo[id(self)] = duplicate = copy(self)
        duplicate.__dict__.update(deepcopy(self.__dict__, memo))
        return duplicate

    def _arguments(self, rows: Any) -> tuple[Any, ...]:
        """Return the arguments of :meth:`evaluate`, of rows ``N x (d + p)`` or a single one."""
        if not self.unknowns:
            return (rows,)
        d = rows.shape[-1] - len(self.unknowns)
        return rows[..., :d], ParameterValues(self.unknowns, rows[..., d:])

    def _with_parameters(self, columns: Tensor, parameters: Tensor | None) -> Tensor:
        """Return ``... x n x (d + p)``, with parameters ``... x p`` at the end of each row."""
        p = len(self.unknowns)
        if parameters is None:
            parameters = self.unknowns.guess
        values = torch.as_tensor(parameters)
        if values.shape[-1:] != (p,):
            raise ValueError(
                f"Physics {self.name!r} has {p} unknown parameter(s) {', '.join(self.unknowns)}; "
                f"expected parameters of shape ... x {p}, found {tuple(values.shape)}."
            )
        batch = np.broadcast_shapes(columns.shape[:-2], values.shape[:-1])
        columns = columns.expand(*batch, *columns.shape[-2:])
        values = values.to(columns).unsqueeze(-2).expand(*columns.shape[:-1], p)
        return torch.cat([columns, values], dim=-1)

    def _or_nan(self, columns: Tensor) -> Tensor:
        """Return ``N x m`` outputs of ``... x n x (d + p)``, not finite where the physics fails."""
        rows = columns.flatten(0, -2)
        try:
            return self.fresh_rows(rows)
        except PhysicsError as error:
            if error.partial is not None:
                return error.partial
            if not error.rows or self.num_outputs is None:
                raise
        if columns.dim() == 2:
            return rows.new_full((len(rows), self.num_outputs), torch.nan)
        # One batch of rows at a time, to learn which of them fail.
        return torch.cat([self._or_nan(batch) for batch in columns.flatten(0, -3)])

    def _shaped(self, Y: Tensor, rows: Tensor) -> Tensor:
        """Return outputs as ``N x m`` in the dtype of the rows, or raise a PhysicsError."""
        n = len(rows)
        is_real = torch.is_tensor(Y) and not Y.is_complex()
        if is_real and Y.dim() == 1:
            Y = Y.unsqueeze(-1)
        is_table = is_real and Y.dim() == 2 and len(Y) == n and Y.shape[1] > 0
        if not is_table or self.num_outputs not in (None, Y.shape[1]):
            expected = f"({n}, m) or ({n},)"
            if self.num_outputs is not None:
                expected = f"({n}, {self.num_outputs}), as before"
            raise PhysicsError(
                f"Physics {self.name!r} returned {outline(Y)}, expected a real tensor of shape "
                f"{expected}, one row per row of X. For a constant return 0 * X[:, 0] + value. "
                f"{self.advice}"
            )
        self.num_outputs = Y.shape[1]
        return Y.to(rows)


def name_of(function: Any, name: str | None, argument: str = "function") -> str:
    """Return a name, by default a function's; raise a TypeError unless it is callable."""
    if not callable(function):
        raise TypeError(f"{argument} must be callable; found {type(function).__name__}.")
    return name or str(getattr(function, "__name__", type(function).__name__))


def symbol(name: str) -> str:
    """Return the name of a column in a formula: without its unit, and ``_`` for other marks."""
    name = normalize("NFKC", name.partition("[")[0].strip())  # as Python does with names
    bare = re.sub(r"\W+", "_", name).strip("_")
    if iskeyword(bare) or bare == "pi":
        return f"{bare}_"
    return f"_{bare}" if bare[:1].isdigit() else bare
