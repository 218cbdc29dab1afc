"""Targets of a model that stand for next states, and the physics in their form."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor

from gpadjust.checks import check_choice, check_kind, checked_number, checked_whole
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import ODEPhysics, ParameterValues, Physics, PhysicsError, as_physics
from gpadjust.states import StateSpec
from gpadjust.states.state_spec import side_by_side, some_columns

Target = Literal["difference", "absolute"]


class Targets:
    r"""Targets of a model that stand for next states.

    They are the change of each predicted state, :math:`y = s' - s`, for an angle the shortest way
    round; or with ``"absolute"`` its next value :math:`s + (s' - s)`, which is continuous along a
    trajectory even if angles are wrapped.
    """

    def __init__(self, spec: StateSpec, target: Target) -> None:
        check_choice("target", target, get_args(Target))
        self.spec, self.target = spec, target
        columns = spec.model_columns  # the moving states come first
        self.predicted = [spec.moving.index(i) for i in spec.predicted]
        self.angles = [place for place, i in enumerate(columns) if i in spec.angle_columns]
        self.of_physics = [columns.index(i) for i in spec.physics_columns]
        names = (*spec.states, *spec.actions)
        self.input_names = tuple(names[i] for i in columns)
        change = "change of " if target == "difference" else ""
        self.output_names = tuple(change + names[i] for i in spec.predicted)

    def inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return raw inputs of a model, ``... x d``; see :attr:`StateSpec.model_columns`."""
        return some_columns(side_by_side(states, actions), self.spec.model_columns)

    def encode(self, states: Tensor, next_states: Tensor) -> Tensor:
        """Return targets ``... x m`` of transitions."""
        predicted = self.spec.predicted
        change = self.spec.change(states, next_states)[..., predicted]
        if self.target == "difference":
            return change
        return states[..., predicted] + change

    def decode(self, states: Tensor, targets: Tensor) -> Tensor:
        """Return next values of the predicted states, ``... x m``."""
        if self.target == "absolute":
            return targets
        return some_columns(states, self.spec.predicted) + targets


class TargetPhysics(Physics):
    r"""The physics of the targets, by an f_p that returns next states.

    Memory, batching and gradients are those of f_p.
    """

    def __init__(self, physics: Physics, targets: Targets) -> None:
        super().__init__(unknowns=physics.unknowns, name=physics.name)
        self.physics, self.targets = physics, targets
        self.num_outputs = len(targets.predicted)

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """Return the targets by the physics, ``N x m``."""
        targets = self.targets
        num_states = len(targets.spec.moving)
        inputs = some_columns(X, targets.of_physics)
        try:
            following = self.physics.of_rows(self.physics.read_rows(inputs, *parameters))
        except PhysicsError as error:
            error.partial = None  # it has next states, not targets
            raise
        check_next_values(self.physics, following, num_states)
        change = following - X[:, :num_states]
        columns = []
        for i in targets.predicted:
            column = change[:, i]
            if i in targets.angles:  # the shortest way round
                column = torch.atan2(column.sin(), column.cos())
            if targets.target == "absolute":
                column = X[:, i] + column
            columns.append(column)
        return torch.stack(columns, dim=-1)

    def forget(self) -> None:
        """Clear the memory of the physics."""
        self.physics.forget()

    def extra_repr(self) -> str:
        """Return the settings in ``repr``."""
        return f"target={self.targets.target!r}"


class AngleInput(InputTransform):
    r"""A transform of each angle :math:`\theta`, in its place, to :math:`\sin\theta, \cos\theta`.

    A stationary kernel on the result is continuous where the angle wraps.

    Args:
        columns: The columns of X that are angles in rad: one or more different numbers, from 0.

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
        check_kind("columns", columns, Sequence, "a sequence of numbers, such as [0]")
        self.columns = tuple(checked_whole("Each of columns", i, 0) for i in columns)
        if not columns or len({*columns}) < len(columns):
            raise ValueError(f"Expected columns as one or more different numbers, got {columns}.")

    def transform(self, X: Tensor) -> Tensor:
        """Map ``... x n x d`` to ``... x n x (d + k)``, for ``k`` angles."""
        if X.shape[-1] <= max(self.columns):
            raise ValueError(
                f"Expected X with an angle in column {max(self.columns)}, got {tuple(X.shape)}."
            )
        parts: list[Tensor] = []
        for i, column in enumerate(X.unbind(-1)):
            parts += [column.sin(), column.cos()] if i in self.columns else [column]
        return torch.stack(parts, dim=-1)

    def column_names(self, names: Sequence[str]) -> list[str]:
        """Return the names of the columns of :meth:`transform`, by the names of those of X."""
        columns: list[str] = []
        for i, name in enumerate(names):
            columns += [f"sin({name})", f"cos({name})"] if i in self.columns else [name]
        return columns

    @property
    def settings(self) -> dict[str, list[int]]:
        """The arguments."""
        return {"columns": [*self.columns]}

    def equals(self, other: InputTransform) -> bool:
        """Return whether ``other`` replaces the same columns."""
        return isinstance(other, AngleInput) and self.columns == other.columns


def check_spec(spec: StateSpec) -> None:
    """Raise a TypeError unless ``spec`` is a StateSpec."""
    check_kind("spec", spec, StateSpec, "a StateSpec, such as StateSpec(['x', 'v'], ['force'])")


def named_physics(physics: Any, spec: StateSpec) -> dict[str, Physics]:
    """Return checked physics of next states by name, from one, a list or a mapping."""
    named: Any = physics
    if not isinstance(named, Mapping):
        several = physics if isinstance(physics, list | tuple) else [physics]
        named = {str(i + 1): function for i, function in enumerate(several)}
    parts: dict[str, Physics] = {}
    for name, function in named.items():
        part = parts[name] = as_physics(function)
        if isinstance(physics, Mapping) and part is not function:  # not the user's object
            part.name = name
        if isinstance(part, ODEPhysics) and part.difference:
            raise ValueError(
                f"Physics {part.name!r} returns the change of the state (difference=True), but "
                "dynamics need the next state; build it with difference=False."
            )
        if part.step is None or spec.step is None:
            continue
        if not math.isclose(part.step, spec.step, rel_tol=1e-6):
            raise ValueError(
                f"Physics {part.name!r} has steps of {part.step:g}, but the spec has "
                f"{spec.step:g}; build it with step={spec.step:g}, or correct the spec."
            )
    return parts


def one_physics(physics: Any, spec: StateSpec, otherwise: str) -> Physics:
    """Return a physics of next states; raise a ValueError, with the way out, unless it is one."""
    parts = [*named_physics(physics, spec).values()]
    if len(parts) != 1:
        names = ", ".join(repr(part.name) for part in parts)
        raise ValueError(f"Expected one physics to follow, got {names}; {otherwise}.")
    return parts[0]


def next_values(
    physics: Physics, spec: StateSpec, states: Tensor, actions: Tensor, parameters: Any = None
) -> Tensor:
    """Return the next states ``... x state_dim`` by a physics; exogenous states do not change."""
    inputs = spec.physics_inputs(states, actions)
    if inputs.dim() == 1:
        inputs = inputs.unsqueeze(0)
    Y = physics(inputs, parameters)
    check_next_values(physics, Y, len(spec.moving))
    following = states.clone()
    following[..., spec.moving] = Y
    return spec.remember(following, states, actions)


def check_next_values(physics: Physics, Y: Tensor, num_states: int) -> None:
    """Raise a ValueError unless the physics returned a column for each state that moves."""
    if Y.shape[-1] != num_states:
        raise ValueError(
            f"Expected physics {physics.name!r} to return the next values of the {num_states} "
            f"states that are neither exogenous nor previous values, got {Y.shape[-1]} columns."
        )


def warn_of_differences(name: str, spec: StateSpec, data: Trajectories, following: Tensor) -> None:
    """Warn if outputs of a physics, read as changes, have at most a third of the error."""
    # Errors in units of the changes, of the outputs as next states and as changes.
    scale = spec.change(data.states, data.next_states).square().nanmean(0).sqrt()
    columns = [i for i in spec.moving if scale[i] > 0]
    errors = []
    for predicted in (following, data.states + following):
        error = spec.change(data.next_states, predicted) / scale
        errors.append(float(error[:, columns].square().nansum().sqrt()))
    if errors[1] < errors[0] / 3:
        warnings.warn(
            f"Physics {name!r} seems to return the change of the state, but dynamics need the next "
            f"state. Read as a change, its error is {errors[1] / errors[0]:.2g} times the error "
            "as the next state. Let it return `next state = state + change`.",
            UserWarning,
            stacklevel=4,
        )


def checked_physics_error(spec: StateSpec, errors: Mapping[str, float] | None) -> dict[str, float]:
    """Return standard deviations of the error of a step of the physics, by state."""
    moving = [spec.states[i] for i in spec.moving]
    for name, sd in (errors or {}).items():
        if name not in moving:
            raise ValueError(f"physics_error names states among {moving}; found {name!r}.")
        checked_number(f"physics_error[{name!r}]", sd, least=0)
    return {**(errors or {})}
