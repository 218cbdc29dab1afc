"""The interface of a physics, and the code that all of them share."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import deepcopy
from operator import index
from typing import Any, Self

import torch
from torch import Size, Tensor

from gpadjust.physics.error import PhysicsError, described
from gpadjust.physics.gradient import central_difference
from gpadjust.physics.unknown import ParameterValues, Unknown, Unknowns

_NONE = Unknowns(None)


class Physics(torch.nn.Module, ABC):
    r"""The crude model :math:`f_p : \mathbb{R}^d \to \mathbb{R}^m` of a system.

    A subclass says in ``evaluate`` what the outputs of some rows are; calling the physics adds
    batch shapes, the choice of columns, and checks. It must be deterministic.

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
        is_emulated: Whether its outputs are estimates, whose errors have a kernel
            (``error_kernel``), as of :class:`~gpadjust.EmulatedPhysics`.

    Raises:
        TypeError: If ``inputs`` are no whole numbers.
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

    is_emulated = False

    def __init__(
        self,
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        super().__init__()
        self.unknowns = _NONE if unknowns is None else Unknowns(unknowns)
        self._p = len(unknowns or ())
        self.inputs: tuple[int, ...] | None = None
        if inputs is not None:
            try:
                self.inputs = tuple(map(index, inputs))
            except TypeError:
                raise TypeError(
                    "inputs must be a sequence of column numbers, such as [0, 2]; found "
                    f"{inputs!r}."
                ) from None
            if not self.inputs:
                raise ValueError("inputs is empty; name at least one column of X, or None for all.")
        self.name = type(self).__name__ if name is None else name
        self.num_outputs: int | None = None
        self._warned: set[str] = set()

    @abstractmethod
    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """The outputs of some rows, without checks.

        Args:
            X: ``N x d``, the columns ``inputs`` only, ``N >= 1``.
            parameters: One argument if there are unknown parameters, their values by name, ``N``
                each: ``p.mass`` or ``p["mass"]``. None otherwise.

        Returns:
            ``N x m`` outputs, or ``N`` if ``m`` is 1.
        """

    def forward(self, X: Tensor, parameters: Tensor | None = None) -> Tensor:
        """The outputs of the physics.

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
        columns, shape = self.read(X), X.shape[:-1]
        # Of the copies of an expanded leaf, each has a gradient of its own.
        for dim in range(0 if X.requires_grad and X.is_leaf else X.dim() - 1):
            if shape[dim] > 1 and X.stride(dim) == 0:
                columns = columns.narrow(dim, 0, 1)
        if self._p or parameters is not None:
            values = self._checked_parameters(parameters, X)
            shape = Size((*torch.broadcast_shapes(X.shape[:-2], values.shape[:-1]), X.shape[-2]))
            columns = _beside(columns, values)
        rows = columns.reshape(-1, columns.shape[-1])
        try:
            Y = self.of_rows(rows)
        except PhysicsError as error:
            if error.inputs is None:
                numbers = torch.arange(len(rows)).reshape(columns.shape[:-1])
                origin = numbers.expand(shape).flatten()
                error.relocate(origin)
                error.inputs = rows.detach()[origin[list(error.rows)]]
            raise
        m = Y.shape[-1]
        return Y.reshape(*columns.shape[:-1], m).expand(*shape, m)

    def or_nan(self, X: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Return the outputs without gradient, NaN in rows at which the physics fails.

        Raises:
            PhysicsError: If it does not say where it fails, or fails everywhere before its number
                of outputs is known.
        """
        with torch.no_grad():
            columns = _beside(self.read(X), self._checked_parameters(parameters, X))
            blocks = columns.reshape(1, -1, columns.shape[-1])
            found = [self._where_it_works(blocks[0])]
            if isinstance(found[0], PhysicsError):
                # A function of all rows may raise an error for what some parameters do to it.
                blocks = columns.reshape(-1, *columns.shape[-2:])
                found = [self._where_it_works(block) for block in blocks]
            errors = [Y for Y in found if isinstance(Y, PhysicsError)]
            if self.num_outputs is None:
                raise errors[0]
            failed = columns.new_full((blocks.shape[1], self.num_outputs), torch.nan)
            values = [failed if isinstance(Y, PhysicsError) else Y for Y in found]
        return torch.cat(values).reshape(*columns.shape[:-1], self.num_outputs)

    def read(self, X: Tensor) -> Tensor:
        """The columns of ``X`` (``... x n x d``) that the physics reads, checked."""
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
                f"{tuple(X.shape)} has {d} column(s), no column {absent}. Pass all, or correct "
                "inputs."
            )
        return X[..., list(self.inputs)]

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if the physics names its columns, and data have them otherwise."""

    def read_rows(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Rows for :meth:`of_rows`, of rows ``N x d`` and parameters of several physics."""
        own = [parameters[0][name].unsqueeze(-1) for name in self.unknowns]
        return torch.cat([self.read(X), *own], dim=-1)

    def in_user_units(self, values: Tensor) -> Tensor:
        """Values of this physics, or targets beside them, in the units that the user knows."""
        return values

    def of_rows(self, rows: Tensor) -> Tensor:
        """The outputs ``N x m`` of rows ``N x (d + p)``, the columns it reads and its parameters.

        They have a graph as far as the rows or the parameters of the module ask for one. The rows
        that an error names are these.
        """
        if len(rows) == 0:
            if self.num_outputs is None:
                raise PhysicsError(
                    f"Physics {self.name!r} was given no rows before its number of outputs was "
                    "known; call it on at least one row first."
                )
            return rows.new_empty(0, self.num_outputs)
        Y = Physics.fresh_rows(self, rows)  # not a subclass's, which may leave evaluate out
        if not torch.is_grad_enabled():
            return Y
        if rows.requires_grad and not Y.requires_grad:
            self._warn_once(
                f"No gradient flows through physics {self.name!r}: X requires grad, its outputs "
                "do not. Wrap the function as BlackBoxPhysics(function) for finite differences; "
                "ignore this if the outputs do not depend on X."
            )
        learns = any(p.requires_grad for p in self.parameters())
        if learns or not Y.requires_grad or rows.requires_grad:
            return Y
        self._warn_once(
            f"Physics {self.name!r} depends on a tensor that requires grad but is not one of "
            "its parameters; it is taken as a constant. To learn it, make it a parameter of a "
            "torch.nn.Module and pass that module; else call requires_grad_(False) on it."
        )
        return Y.detach()

    def fresh_rows(self, rows: Tensor) -> Tensor:
        """Return :meth:`of_rows` without the memory, checked, in the dtype of the rows."""
        try:
            Y = self.evaluate(*(self._arguments(rows) if self._p else (rows,)))
        except PhysicsError as error:
            if error.partial is not None:
                error.partial = self._shaped(error.partial, len(rows)).to(rows)
            raise
        except Exception as error:
            raise PhysicsError(
                f"Physics {self.name!r} raised {described(error)}."
                f"{self._arguments_hint(error)} The call was for {len(rows)} row(s):",
                range(len(rows)),
            ) from error
        Y = self._shaped(Y, len(rows)).to(rows)
        # A finite sum has finite terms only, and is the faster look.
        if not Y.detach().sum().isfinite():
            bad = (~Y.isfinite().all(-1)).nonzero().flatten().tolist()
            if bad:
                raise PhysicsError(
                    f"Physics {self.name!r} returned NaN or inf in {len(bad)} of {len(rows)} "
                    "row(s), expected finite numbers. Correct it, or exclude such inputs:",
                    bad,
                    partial=Y.detach(),
                )
        return Y

    def _arguments(self, rows: Tensor) -> tuple[Tensor, *tuple[ParameterValues, ...]]:
        """The arguments of :meth:`evaluate`, of rows ``N x (d + p)``."""
        d = rows.shape[-1] - self._p
        return (rows[:, :d], self.unknowns.named(rows[:, d:])) if self._p else (rows,)

    def forget(self) -> None:
        """Empty the memory of evaluated rows, if there is one."""

    def extra_repr(self) -> str:
        """The settings that ``repr`` shows."""
        told = f"name={self.name!r}, inputs={self.inputs}, num_outputs={self.num_outputs}"
        return f"{told}, unknowns={dict(self.unknowns)!r}" if self.unknowns else told

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """The physics itself if it has no parameters and buffers, else a copy."""
        if not [*self.parameters(), *self.buffers()]:
            return self
        copy = type(self).__new__(type(self))
        memo[id(self)] = copy
        copy.__dict__.update(deepcopy(self.__dict__, memo))
        return copy

    def _checked_parameters(self, parameters: Tensor | None, X: Tensor) -> Tensor:
        names = self.unknowns.names
        if parameters is None:
            return self.unknowns.guess.to(X)
        if not torch.is_tensor(parameters) or parameters.shape[-1:] != (len(names),) or not names:
            found = tuple(parameters.shape) if torch.is_tensor(parameters) else repr(parameters)
            raise ValueError(
                f"Physics {self.name!r} has {len(names)} unknown parameter(s)"
                f"{': ' * bool(names)}{', '.join(names)}; expected parameters of shape ... x "
                f"{len(names)}, found {found}."
            )
        return parameters.to(X)

    def _where_it_works(self, rows: Tensor) -> Tensor | PhysicsError:
        """Return ``N x m`` outputs, NaN where the physics fails, or its error if all rows fail."""
        working = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
        while True:
            try:
                Y = self.fresh_rows(rows[working])
            except PhysicsError as error:
                if error.partial is None:
                    if not error.rows:
                        raise
                    working[working.nonzero().flatten()[list(error.rows)]] = False
                    if not working.any():
                        return error
                    continue
                Y = error.partial
            values = Y.new_full((len(rows), Y.shape[-1]), torch.nan)
            values[working] = Y.where(Y.isfinite().all(-1, keepdim=True), torch.nan)
            return values

    def jacobian(
        self, rows: Tensor, step: Tensor | None = None, with_values: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Outputs and their Jacobian by differences in X, zero for parameters, in a single call.

        Returns:
            ``N x m``, or nothing (``0 x m``) if values are not asked for, and ``N x m x (d + p)``.
        """
        d, also, kept = rows.shape[1] - self._p, rows if with_values else rows[:0], []
        parameters = rows[:, d:].repeat_interleave(d, dim=0).repeat(2, 1)

        def moved(X: Tensor) -> Tensor:
            Y = self.fresh_rows(torch.cat([also, torch.cat([X, parameters], dim=-1)]))
            kept.append(Y[: len(also)])
            return Y[len(also) :]

        slope = central_difference(moved, rows[:, :d], step)
        return kept[0], torch.nn.functional.pad(slope, (0, self._p))

    def _arguments_hint(self, error: Exception) -> str:
        """Return a hint for a function that was called with a wrong number of arguments."""
        if not isinstance(error, TypeError) or "positional argument" not in str(error):
            return ""
        if self._p:
            return (
                " The values of its unknown parameters, p, are its last argument: p."
                f"{self.unknowns.names[0]} is one for each row."
            )
        return " Parameters that are to be learnt are named as unknowns={'mass': Unknown(...)}."

    def _shaped(self, Y: Tensor, n: int) -> Tensor:
        """Outputs as ``n x m``, if they are that or ``n``."""
        expected = f"a real tensor of shape ({n}, m) or ({n},), one row per row of X"
        if not torch.is_tensor(Y) or Y.is_complex():
            found = Y.dtype if torch.is_tensor(Y) else type(Y).__name__
            raise PhysicsError(f"Physics {self.name!r} returned {found}, expected {expected}.")
        if Y.dim() not in (1, 2) or len(Y) != n or Y.shape[-1] == 0:
            raise PhysicsError(
                f"Physics {self.name!r} returned shape {tuple(Y.shape)}, expected {expected}. For "
                "a constant return X.new_full((X.shape[0],), value); for a function of a single "
                "row take BlackBoxPhysics(function, batched=False)."
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

    def _warn_once(self, message: str) -> None:
        if message not in self._warned:
            self._warned.add(message)
            warnings.warn(message, UserWarning, stacklevel=2)


def _beside(columns: Tensor, values: Tensor) -> Tensor:
    """Rows ``... x n x d`` and, at the end of each, values ``... x p``."""
    batch = torch.broadcast_shapes(columns.shape[:-2], values.shape[:-1])
    rows = columns.expand(*batch, *columns.shape[-2:])
    values = values.unsqueeze(-2).expand(*rows.shape[:-1], values.shape[-1])
    return torch.cat([rows, values], dim=-1)
