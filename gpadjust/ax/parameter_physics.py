"""A physics of the parameters of a search space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from inspect import Parameter, signature
from typing import Any, Self

from torch import Tensor
from torch.nn import Module

from gpadjust.physics import FunctionPhysics, Physics, as_physics
from gpadjust.physics.import_path import import_path, physics_from_path


class ParameterPhysics:
    """A physics of the parameters of an Ax search space, for a ``ModelConfig``.

    Its inputs have the units of the search space and its outputs those of its metric, whatever Ax
    transforms before a model (:class:`~gpadjust.ax.TellPhysics`). Ax saves it by its import path.

    Args:
        physics: The physics f_p. A function with parameters as its arguments,
            ``f_p(pressure, temperature)``, gets tensors of ``N`` values of these, in any order of
            the search space. Any other function or :class:`~gpadjust.physics.Physics` gets
            ``N x d`` rows, a column for each parameter, in the order of the search space. It
            returns ``N`` values or ``N x 1``. Or an import path, ``"package.module:f_p"``.

    Raises:
        TypeError: If ``physics`` is not a physics.
        ValueError: If it is a path that cannot be imported.

    Example:
        >>> from gpadjust.ax import ParameterPhysics
        >>> ParameterPhysics("torch:sin").path
        'torch:sin'
        >>> ParameterPhysics(lambda x1, x2: x1 * x2).read_names(["x2", "x1", "x3"])
        ('x1', 'x2')
    """

    def __init__(self, physics: Any) -> None:
        path = None
        if isinstance(physics, ParameterPhysics):
            path = physics.path
            physics = physics.physics
        if isinstance(physics, str):
            path = physics
            physics = physics_from_path(path)
            if type(physics) is FunctionPhysics:
                physics = physics.function  # its arguments may have names of parameters
        as_physics(physics)  # raises the error of anything else
        self._path = path
        self.physics: Physics | Callable[..., Tensor] = physics
        self._by_names: dict[tuple[str, ...], Physics] = {}

    @property
    def name(self) -> str:
        """The name of the physics in messages."""
        return as_physics(self.physics).name

    @property
    def path(self) -> str | None:
        """The import path for saving; None without one, for example of a lambda."""
        return self._path or import_path(self.physics)

    def read_names(self, parameters: Sequence[str]) -> tuple[str, ...]:
        """Return the parameters that the physics reads, in its order, of those of a search space.

        Raise a ValueError if it has several arguments that are not all parameters.
        """
        # Arguments without a default must be parameters; others may be.
        arguments = self._arguments()
        named = [name for name in arguments if name in parameters]
        needed = [name for name, default in arguments.items() if default is Parameter.empty]
        if named and set(needed) <= set(parameters):
            return tuple(named)
        # One argument of another name is a tensor of all columns; several are a misspelling.
        if len(needed) > 1 or (named and len(arguments) > 1):
            raise ValueError(
                f"The physics {self.name!r} takes {', '.join(arguments)}, but "
                f"{', '.join(name for name in needed if name not in parameters)} is not a "
                f"parameter of the search space, which has {', '.join(parameters)}. Name its "
                "arguments as parameters, or let it take one tensor with a column for each."
            )
        return tuple(parameters)

    def take_rows(self, names: tuple[str, ...]) -> Physics:
        """Return the physics of rows with the columns ``names``: each time the same object."""
        if names not in self._by_names:
            physics = self.physics
            # A function of named arguments gets columns, any other one rows.
            if not isinstance(physics, Physics) and set(names) <= set(self._arguments()):
                function = partial(_of_columns, physics, names)
                physics = FunctionPhysics(function, name=self.name)
            self._by_names[names] = as_physics(physics)
        return self._by_names[names]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.path or self.name!r})"

    def __eq__(self, other: object) -> bool:
        """Return whether another one has the same physics, by identity or by path."""
        return isinstance(other, ParameterPhysics) and (
            self.physics is other.physics or (self.path is not None and self.path == other.path)
        )

    def __hash__(self) -> int:
        return hash(self.name)

    def __deepcopy__(self, memo: Any) -> Self:
        """Return the same object: Ax copies settings before each fit."""
        return self

    def _arguments(self) -> dict[str, Any]:
        """Return the named arguments of a function, with their defaults."""
        if isinstance(self.physics, Module):
            return {}  # called with one tensor
        try:
            parameters = signature(self.physics).parameters
        except ValueError:  # a builtin function
            return {}
        kinds = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
        return {name: p.default for name, p in parameters.items() if p.kind in kinds}


def _of_columns(function: Callable[..., Tensor], names: tuple[str, ...], X: Tensor) -> Tensor:
    """Return the values of a function of named arguments at rows."""
    return function(**dict(zip(names, X.unbind(-1), strict=True)))
