"""A physics of the parameters of a search space."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import Parameter, signature
from typing import Any, Self

from torch import Tensor
from torch.nn import Module

from gpadjust.physics import FunctionPhysics, Physics, as_physics
from gpadjust.physics.import_path import import_path, physics_from_path


class ParameterPhysics:
    """A physics of the parameters of an Ax search space, as one keeps it in a ``ModelConfig``.

    It is asked in the units of the search space and answers in those of its metric, whatever Ax
    transforms before a model sees it (:class:`~gpadjust.ax.TellPhysics`). Ax saves it by its import
    path. All that takes a physics in this room makes one of what it is given.

    Args:
        physics: The physics f_p. A function whose arguments have names of parameters,
            ``f_p(pressure, temperature)``, is given tensors of ``N`` values of these, whatever the
            order of the search space. Any other function or :class:`~gpadjust.physics.Physics` is
            given ``N x d`` rows, a column for each parameter, in the order of the search space. It
            returns ``N`` values or ``N x 1``. Or an import path, ``"package.module:f_p"``.

    Raises:
        TypeError: If it is no physics.
        ValueError: If it is a path that cannot be imported.

    Example:
        >>> from gpadjust.ax import ParameterPhysics
        >>> ParameterPhysics("torch:sin").path
        'torch:sin'
        >>> ParameterPhysics(lambda x1, x2: x1 * x2).names_of(["x2", "x1", "x3"])
        ('x1', 'x2')
    """

    def __init__(self, physics: Any) -> None:
        path = None
        if isinstance(physics, ParameterPhysics):
            path, physics = physics.path, physics.physics
        if isinstance(physics, str):
            path, physics = physics, physics_from_path(physics)
            if type(physics) is FunctionPhysics:
                physics = physics.function  # whose arguments may have names of parameters
        as_physics(physics)  # says what is expected
        self._path = path
        self.physics: Physics | Callable[..., Tensor] = physics
        self._made: dict[tuple[str, ...], Physics] = {}

    @property
    def name(self) -> str:
        """The name of the physics in messages."""
        own = self.physics
        return own.name if isinstance(own, Physics) else as_physics(own).name

    @property
    def path(self) -> str | None:
        """The import path by which it is saved; None if it has none, as a lambda."""
        return self._path or import_path(self.physics)

    def names_of(self, parameters: Sequence[str]) -> tuple[str, ...]:
        """Return the parameters that it reads, in its order.

        Args:
            parameters: Those of the search space, in its order.

        Raises:
            ValueError: If it is a function of several arguments that are not all parameters.
        """
        arguments = self._arguments()
        named = [name for name in arguments if name in parameters]
        needed = [name for name, default in arguments.items() if default is Parameter.empty]
        if named and set(needed) <= set(parameters):
            return tuple(named)
        if len(needed) > 1 or (named and len(arguments) > 1):
            raise ValueError(
                f"The physics {self.name!r} takes {', '.join(arguments)}, but "
                f"{', '.join(name for name in needed if name not in parameters)} is no parameter "
                f"of the search space, which has {', '.join(parameters)}. Give its arguments the "
                "names of parameters, or let it take one tensor with a column for each."
            )
        return tuple(parameters)

    def of(self, names: tuple[str, ...]) -> Physics:
        """Return it as a physics of rows with the columns ``names``, those of :meth:`names_of`.

        It is made once, so that what is remembered of f_p outlives a model.
        """
        if names not in self._made:
            physics = self.physics
            if not isinstance(physics, Physics) and set(names) <= set(self._arguments()):
                of_rows = partial(_of_columns, physics, names)
                physics = FunctionPhysics(of_rows, name=self.name)
            self._made[names] = as_physics(physics)
        return self._made[names]

    def __repr__(self) -> str:
        """Return its path, or the name of a physics without one."""
        return f"{type(self).__name__}({self.path or self.name!r})"

    def __eq__(self, other: object) -> bool:
        """Return whether it is of the same physics."""
        return isinstance(other, ParameterPhysics) and (
            self.physics is other.physics or (self.path is not None and self.path == other.path)
        )

    def __hash__(self) -> int:
        """Return the hash of its name, which may be that of another."""
        return hash(self.name)

    def __deepcopy__(self, memo: Any) -> Self:
        """Return itself: Ax copies settings before each fit."""
        return self

    def _arguments(self) -> dict[str, Any]:
        """Return the named arguments of a function, with their defaults."""
        if isinstance(self.physics, Module):
            return {}
        try:
            found = signature(self.physics).parameters
        except ValueError:  # a builtin
            return {}
        kinds = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
        return {name: p.default for name, p in found.items() if p.kind in kinds}


def parts_of(physics: Any) -> list[Any]:
    """Return the physics of a metric: a list, tuple or dictionary of several; none of None."""
    if isinstance(physics, Mapping):
        return [*physics.values()]
    if isinstance(physics, list | tuple):
        return [*physics]
    return [] if physics is None else [physics]


def of_each(change: Callable[[Any], Any], physics: Any) -> Any:
    """Return the physics of a metric, each changed, in the form in which they are given."""
    if isinstance(physics, Mapping):
        return {name: change(part) for name, part in physics.items()}
    if isinstance(physics, list | tuple):
        return [change(part) for part in physics]
    return change(physics)


def _of_columns(function: Callable[..., Tensor], names: tuple[str, ...], X: Tensor) -> Tensor:
    """Return a function of named arguments at rows."""
    return function(**dict(zip(names, X.unbind(-1), strict=True)))
