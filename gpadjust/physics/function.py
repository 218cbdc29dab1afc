"""Physics of a torch function, of several physics side by side, and of other callables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import cast

import numpy as np
import torch
from torch import Tensor

from gpadjust.physics.base import Physics
from gpadjust.physics.error import PhysicsError
from gpadjust.physics.unknown import ParameterValues, Unknown

AnyPhysics = Physics | Callable[[Tensor], Tensor]
Parts = Sequence[AnyPhysics] | Mapping[str, AnyPhysics]


class FunctionPhysics(Physics):
    """Physics given as a torch function, differentiable by autograd.

    Args:
        function: Maps rows ``N x d`` to outputs ``N x m``, or ``N`` if ``m`` is 1. The parameters
            of a ``torch.nn.Module`` that require gradients, as those of a network, are brought to
            their most likely values with the GP's hyper-parameters.
        unknowns: Unknown parameters by name; their values are then the function's second argument,
            ``N`` each: ``lambda X, p: p.mass * X[:, 0]``.
        inputs: The columns of X that the function reads. Default: all.
        name: The name in messages. Default: the function's.

    Raises:
        TypeError: If ``function`` is not callable.

    Example:
        >>> import torch
        >>> physics = FunctionPhysics(lambda X: X[:, 0] * X[:, 1], name="power")
        >>> physics(torch.tensor([[230.0, 2.0], [230.0, 3.0]], dtype=torch.float64))
        tensor([[460.],
                [690.]], dtype=torch.float64)
    """

    def __init__(
        self,
        function: Callable[..., Tensor],
        *,
        unknowns: Mapping[str, Unknown] | None = None,
        inputs: Sequence[int] | None = None,
        name: str | None = None,
    ) -> None:
        if not callable(function):
            raise TypeError(f"function must be callable; found {type(function).__name__}.")
        name = name or getattr(function, "__name__", type(function).__name__)
        super().__init__(unknowns=unknowns, inputs=inputs, name=name)
        self.function = function

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """The function's outputs; a PhysicsError if it computes with NumPy."""
        try:
            Y = self.function(X, *parameters)
            if not isinstance(Y, np.ndarray | np.generic):
                return Y
            cause = None
        except RuntimeError as error:
            if "Can't call numpy() on Tensor that requires grad" not in str(error):
                raise
            cause = error
        raise PhysicsError(
            f"Physics {self.name!r} computes with NumPy, expected torch; wrap the function as "
            "BlackBoxPhysics(function)."
        ) from cause


class JoinedPhysics(Physics):
    """Several physics of the same inputs, their outputs side by side.

    Each part reads its own columns of X, and has its own memory and gradient.

    Args:
        physics: ``k`` physics or callables (see ``as_physics``), or a mapping from names to such.
        name: The name in messages. Default: the class's.

    Attributes:
        parts: The ``k`` physics.
        names: One name for each. Default: that of the physics, or ``f_i`` for the i-th (from 1) if
            it is a lambda or shares its name with another.
        num_outputs: ``k m``, for ``k`` parts of ``m`` outputs each; None until the first call.

    Raises:
        TypeError: If ``physics`` is no list, or no mapping with text as keys, of physics.
        ValueError: If ``physics`` is empty.

    Example:
        >>> joined = JoinedPhysics([torch.sin, torch.cos])
        >>> joined.names
        ('sin', 'cos')
        >>> joined(torch.zeros(1, 1))
        tensor([[0., 1.]])
    """

    def __init__(self, physics: Parts, *, name: str | None = None) -> None:
        if not isinstance(physics, Sequence | Mapping):
            raise TypeError(
                "JoinedPhysics takes a list of physics, or a mapping from names to physics; found "
                f"a {type(physics).__name__}. For a single one use as_physics(physics)."
            )
        if not physics:
            raise ValueError("There is no physics to join; give at least one.")
        given = [*physics.values()] if isinstance(physics, Mapping) else [*physics]
        parts = [as_physics(part) for part in given]
        super().__init__(unknowns=_in_common(parts), name=name)
        self.names = _names([*physics] if isinstance(physics, Mapping) else None, parts)
        for part, origin, own in zip(parts, given, self.names, strict=True):
            if part is not origin:  # a wrapper of ours
                part.name = own
        self.parts = torch.nn.ModuleList(parts)
        self.is_emulated = any(part.is_emulated for part in parts)

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """The outputs ``N x (k m)`` of the parts, those of the first part first."""
        return self._of_parts(lambda part, own: part.of_rows(own), X, *parameters)

    def of_rows(self, rows: Tensor) -> Tensor:
        """Return the outputs of rows; checks, memory and gradients are those of the parts."""
        return self.evaluate(*self._arguments(rows))

    def fresh_rows(self, rows: Tensor) -> Tensor:
        """Return :meth:`of_rows` without the memory of the parts."""
        return self._of_parts(lambda part, own: part.fresh_rows(own), *self._arguments(rows))

    def _of_parts(
        self, ask: Callable[[Physics, Tensor], Tensor], X: Tensor, *parameters: ParameterValues
    ) -> Tensor:
        """Return the results of a function of each part and its rows, side by side."""
        outputs = []
        for name, part in zip(self.names, cast(Iterable[Physics], self.parts), strict=True):
            try:
                outputs.append(ask(part, part.read_rows(X, *parameters)))
            except PhysicsError as error:
                error.partial = None  # outputs of this part alone
                if name != part.name:
                    error.add_note(f"This physics is {name!r} of {self.names}.")
                raise
        counts = {name: Y.shape[1] for name, Y in zip(self.names, outputs, strict=True)}
        if len(set(counts.values())) > 1:
            found = ", ".join(f"{count} of {name!r}" for name, count in counts.items())
            raise PhysicsError(
                f"The parts of physics {self.name!r} differ in their number of outputs: found "
                f"{found}; expected the same of each. Make them predict the same quantities."
            )
        Y = torch.cat(outputs, dim=-1)
        self.num_outputs = Y.shape[1]
        return Y

    def check_names(self, names: Sequence[str]) -> None:
        """Raise a ValueError if a part names its columns, and data have them otherwise."""
        for part in cast(Iterable[Physics], self.parts):
            part.check_names(names)

    def forget(self) -> None:
        """Empty the memory of the parts."""
        for part in cast(Iterable[Physics], self.parts):
            part.forget()

    def extra_repr(self) -> str:
        """The settings that ``repr`` shows."""
        return f"name={self.name!r}, names={self.names}, num_outputs={self.num_outputs}"


def as_physics(physics: AnyPhysics | Parts) -> Physics:
    """Takes a physics as it is, wraps any other callable, and joins several.

    Args:
        physics: A physics; or a torch function of rows ``N x d``, which becomes a
            ``FunctionPhysics``; or a list, tuple or dict of these, which become a
            ``JoinedPhysics`` if there is more than one.

    Raises:
        TypeError: If ``physics`` is none of these, or a class instead of an instance of it.
        ValueError: If the list is empty.

    Example:
        >>> as_physics(torch.sin)
        FunctionPhysics(name='sin', inputs=None, num_outputs=None)
        >>> as_physics([torch.sin, torch.cos]).names
        ('sin', 'cos')
    """
    if isinstance(physics, Physics):
        return physics
    if isinstance(physics, list | tuple | dict):
        joined = JoinedPhysics(physics)
        return joined if len(joined.parts) > 1 else cast(Physics, joined.parts[0])
    if not callable(physics) or isinstance(physics, type):
        found = f"a {type(physics).__name__}"
        if isinstance(physics, type):
            found = f"the class {physics.__name__}"
        raise TypeError(
            f"physics must be a Physics or a callable, or a list of them; found {found}. Pass a "
            "torch function of rows N x d, ODEPhysics(rhs, step, state_dim) for an equation of "
            "motion, or BlackBoxPhysics(function) for NumPy code and simulators."
        )
    return FunctionPhysics(physics)


def _in_common(parts: Sequence[Physics]) -> dict[str, Unknown]:
    """The unknown parameters of several physics; parameters of one name are one."""
    found: dict[str, Unknown] = {}
    for part in parts:
        for name, unknown in part.unknowns.items():
            if found.setdefault(name, unknown) != unknown:
                raise ValueError(
                    f"Several physics have an unknown parameter {name!r}, which is then one "
                    f"parameter, but with different priors: {found[name]} and {unknown}. Give one "
                    "prior, or different names."
                )
    return found


def _names(keys: list[str] | None, parts: list[Physics]) -> tuple[str, ...]:
    if keys is not None:
        wrong = [key for key in keys if not isinstance(key, str)]
        if wrong:
            raise TypeError(f"The names of joined physics must be text; found {wrong}.")
        return tuple(keys)
    own = [part.name for part in parts]
    numbered = [f"f_{i}" for i in range(1, len(own) + 1)]
    names = [
        name if own.count(name) == 1 and name != "<lambda>" else number
        for name, number in zip(own, numbered, strict=True)
    ]
    # A physics may be called f_2 without being the second.
    return tuple(names if len(set(names)) == len(names) else numbered)
