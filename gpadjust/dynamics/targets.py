"""Targets of a model that stand for next states, and the physics in their form."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor

from gpadjust.checks import check_choice, checked_number
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import ODEPhysics, ParameterValues, Physics, PhysicsError, as_physics
from gpadjust.states import StateSpec
from gpadjust.states.state_spec import side_by_side, some_columns

Target = Literal["difference", "absolute"]


class Targets:
    r"""Targets of a model that stand for next states.

    They are the change of each predicted state, :math:`y = s' - s`, of an angle the shortest way
    round; or with ``"absolute"`` its next value :math:`s + (s' - s)`, which is continuous along a
    trajectory even where angles come wrapped.

    Raises:
        ValueError: If ``target`` is neither.
    """

    def __init__(self, spec: StateSpec, target: Target) -> None:
        check_choice("target", target, get_args(Target))
        self.spec = spec
        self.target = target
        self.predicted = [spec.moving.index(i) for i in spec.predicted]
        read = spec.model_columns
        self.angles = [place for place, i in enumerate(read) if i in spec.angle_columns]
        self.of_physics = [read.index(i) for i in spec.physics_columns]

    @property
    def input_names(self) -> tuple[str, ...]:
        """The names of the columns of :meth:`inputs`."""
        names = (*self.spec.states, *self.spec.actions)
        return tuple(names[i] for i in self.spec.model_columns)

    @property
    def output_names(self) -> tuple[str, ...]:
        """The names of the targets."""
        names = [self.spec.states[i] for i in self.spec.predicted]
        return tuple(f"change of {n}" if self.target == "difference" else n for n in names)

    def inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """The raw inputs of a model, ``... x d``; see :attr:`StateSpec.model_columns`."""
        return some_columns(side_by_side(states, actions), self.spec.model_columns)

    def encode(self, states: Tensor, next_states: Tensor) -> Tensor:
        """Targets ``... x m`` of transitions."""
        predicted = self.spec.predicted
        change = self.spec.change(states, next_states)[..., predicted]
        return change if self.target == "difference" else states[..., predicted] + change

    def decode(self, states: Tensor, targets: Tensor) -> Tensor:
        """Next values of the predicted states, ``... x m``."""
        if self.target == "absolute":
            return targets
        return some_columns(states, self.spec.predicted) + targets


class TargetPhysics(Physics):
    r"""Turns f_p, which returns next states, into a physics of the targets.

    Memory, batching and gradients are those of the physics itself.
    """

    def __init__(self, physics: Physics, targets: Targets) -> None:
        super().__init__(unknowns=physics.unknowns, name=physics.name)
        self.physics = physics
        self.targets = targets
        self.num_outputs = len(targets.predicted)

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the targets that the physics stands for, ``N x m``."""
        targets = self.targets
        num_states = len(targets.spec.moving)
        states = X[:, :num_states]
        read = some_columns(X, targets.of_physics)
        try:
            following = self.physics.of_rows(self.physics.read_rows(read, *parameters))
        except PhysicsError as error:
            error.partial = None  # next states, which are no targets
            raise
        check_next_values(self.physics, following, num_states)
        change = following - states
        columns = []
        for i in targets.predicted:
            column = change[:, i]
            if i in targets.angles:
                column = torch.atan2(column.sin(), column.cos())
            columns.append(column if targets.target == "difference" else states[:, i] + column)
        return torch.stack(columns, dim=-1)

    def forget(self) -> None:
        """Forget what the physics remembers."""
        self.physics.forget()

    def extra_repr(self) -> str:
        """The settings that ``repr`` shows."""
        return f"target={self.targets.target!r}"


class AngleInput(InputTransform):
    r"""Replaces each angle :math:`\theta` in its place by :math:`\sin\theta, \cos\theta`.

    A stationary kernel on the result has no seam where the angle wraps.

    Args:
        columns: The columns of X that are angles in rad.

    Raises:
        TypeError: If ``columns`` is no sequence of whole numbers.
        ValueError: If ``columns`` is empty, or has a negative or repeated number.

    Example:
        >>> import torch
        >>> AngleInput([0])(torch.tensor([[0.0, 7.0]]))
        tensor([[0., 1., 7.]])
    """

    is_one_to_many = False
    transform_on_train = True
    transform_on_eval = True
    transform_on_fantasize = True

    def __init__(self, columns: Sequence[int]) -> None:
        super().__init__()
        if not isinstance(columns, Sequence) or not all(isinstance(i, int) for i in columns):
            raise TypeError(
                f"Expected columns as a sequence of numbers, such as [0], got {columns!r}."
            )
        self.columns = tuple(columns)
        distinct = set(self.columns)
        if not distinct or len(distinct) < len(self.columns) or min(distinct) < 0:
            raise ValueError(
                f"Expected columns to be one or more different numbers >= 0, got {columns}."
            )

    def transform(self, X: Tensor) -> Tensor:
        """Map ``... x n x d`` to ``... x n x (d + k)``, for ``k`` angles."""
        if X.shape[-1] <= max(self.columns):
            raise ValueError(
                f"Expected X with an angle in column {max(self.columns)}, got shape "
                f"{tuple(X.shape)}."
            )
        parts: list[Tensor] = []
        for i, column in enumerate(X.unbind(-1)):
            parts += [column.sin(), column.cos()] if i in self.columns else [column]
        return torch.stack(parts, dim=-1)

    def column_names(self, names: Sequence[str]) -> list[str]:
        """The names of the columns of :meth:`transform`, of those of X."""
        found: list[str] = []
        for i, name in enumerate(names):
            found += [f"sin({name})", f"cos({name})"] if i in self.columns else [name]
        return found

    @property
    def settings(self) -> dict[str, list[int]]:
        """The arguments that make it again."""
        return {"columns": [*self.columns]}

    def equals(self, other: InputTransform) -> bool:
        """True if ``other`` replaces the same columns."""
        return isinstance(other, AngleInput) and self.columns == other.columns


def check_spec(spec: StateSpec) -> None:
    """Raise a TypeError unless it is one."""
    if not isinstance(spec, StateSpec):
        raise TypeError(
            f"Expected spec as a StateSpec, such as StateSpec(['x', 'v'], ['force']); found "
            f"{spec!r}."
        )


def named_physics(physics: Any, spec: StateSpec) -> dict[str, Physics]:
    """Return checked physics of next states by name: one, or those of a list or mapping."""
    given = physics if isinstance(physics, list | tuple | Mapping) else [physics]
    if not isinstance(given, Mapping):
        given = {str(i + 1): each for i, each in enumerate(given)}
    parts: dict[str, Physics] = {}
    for name, each in given.items():
        part = parts[name] = as_physics(each)
        if isinstance(physics, Mapping) and part is not each:  # a wrapper of ours
            part.name = name
        if isinstance(part, ODEPhysics) and part.difference:
            raise ValueError(
                f"Physics {part.name!r} returns the change of the state (difference=True), but "
                "dynamics take the next state from it; build it with difference=False."
            )
        step = part.step if isinstance(part, ODEPhysics) else spec.step
        if spec.step is not None and not math.isclose(step or 0.0, spec.step, rel_tol=1e-6):
            raise ValueError(
                f"Physics {part.name!r} makes steps of {step:g}, but the spec says {spec.step:g}; "
                f"build it with step={spec.step:g}, or correct the spec."
            )
    return parts


def one_physics(physics: Any, spec: StateSpec, otherwise: str) -> Physics:
    """Return a physics of next states; a ValueError, with the way out, unless there is one."""
    parts = [*named_physics(physics, spec).values()]
    if len(parts) != 1:
        names = ", ".join(repr(part.name) for part in parts)
        raise ValueError(f"Expected one physics to follow, got {names}; {otherwise}.")
    return parts[0]


def check_next_values(physics: Physics, Y: Tensor, num_states: int) -> None:
    """Raise a ValueError unless the physics has returned as many columns as there are states."""
    if Y.shape[-1] != num_states:
        raise ValueError(
            f"Expected physics {physics.name!r} to return the next values of the {num_states} "
            f"states that are neither exogenous nor previous values, got {Y.shape[-1]} columns."
        )


def warn_of_differences(
    name: str, spec: StateSpec, data: Trajectories, columns: list[int], change: Tensor
) -> None:
    """Warn if the physics seems to return the change of the state instead of the next state.

    It does if the state plus what it returned errs by less than a third, in units of the root mean
    square of each state's true change. ``change``, ``N x m``, is that of the states in ``columns``
    if the physics returns next states.
    """
    truth = spec.change(data.states, data.next_states)
    scale = truth.square().nanmean(0).sqrt()[columns]
    errors = []
    for added in (torch.zeros_like(data.states), data.states):
        predicted = data.states.clone()
        predicted[:, columns] += change + added[:, columns]
        error = spec.change(data.next_states, predicted)[:, columns]
        errors.append(float((error[:, scale > 0] / scale[scale > 0]).square().nansum().sqrt()))
    if errors[1] < errors[0] / 3:
        warnings.warn(
            f"Physics {name!r} seems to return the change of the state, but dynamics take the next "
            f"state from it. As a change, its error is {errors[1] / errors[0]:.2g} times that of "
            "the next state. Let it return `next state = state + change`.",
            UserWarning,
            stacklevel=4,
        )


def checked_physics_error(spec: StateSpec, given: Mapping[str, float] | None) -> dict[str, float]:
    """Standard deviations of the error of a step of the physics, by state; empty for None."""
    moving = [spec.states[i] for i in spec.moving]
    for name, sd in {**(given or {})}.items():
        if name not in moving:
            raise ValueError(f"physics_error is of states among {moving}; found {name!r}.")
        checked_number(f"physics_error[{name!r}]", sd, least=0)
    return {**(given or {})}
