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

    They are the change of each predicted state, :math:`y = s' - s`, of an angle the shortest way
    round; or with ``"absolute"`` its next value :math:`s + (s' - s)`, which is continuous along a
    trajectory even where angles come wrapped.
    """

    def __init__(self, spec: StateSpec, target: Target) -> None:
        check_choice("target", target, get_args(Target))
        self.spec = spec
        self.target = target
        read = spec.model_columns  # which begin with the moving states
        self.predicted = [spec.moving.index(i) for i in spec.predicted]
        self.angles = [place for place, i in enumerate(read) if i in spec.angle_columns]
        self.of_physics = [read.index(i) for i in spec.physics_columns]
        names = (*spec.states, *spec.actions)
        self.input_names = tuple(names[i] for i in read)
        change = "change of " if target == "difference" else ""
        self.output_names = tuple(change + names[i] for i in spec.predicted)

    def inputs(self, states: Tensor, actions: Tensor) -> Tensor:
        """Return raw inputs of a model, ``... x d``; see :attr:`StateSpec.model_columns`."""
        return some_columns(side_by_side(states, actions), self.spec.model_columns)

    def encode(self, states: Tensor, next_states: Tensor) -> Tensor:
        """Return targets ``... x m`` of transitions."""
        predicted = self.spec.predicted
        change = self.spec.change(states, next_states)[..., predicted]
        return change if self.target == "difference" else states[..., predicted] + change

    def decode(self, states: Tensor, targets: Tensor) -> Tensor:
        """Return next values of the predicted states, ``... x m``."""
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
        targets, num_states = self.targets, len(self.targets.spec.moving)
        read = some_columns(X, targets.of_physics)
        try:
            following = self.physics.of_rows(self.physics.read_rows(read, *parameters))
        except PhysicsError as error:
            error.partial = None  # next states, which are no targets
            raise
        check_next_values(self.physics, following, num_states)
        change, columns = following - X[:, :num_states], []
        for i in targets.predicted:
            column = change[:, i]
            if i in targets.angles:
                column = torch.atan2(column.sin(), column.cos())
            columns.append(column if targets.target == "difference" else X[:, i] + column)
        return torch.stack(columns, dim=-1)

    def forget(self) -> None:
        """Forget what the physics remembers."""
        self.physics.forget()

    def extra_repr(self) -> str:
        """Return the settings that ``repr`` shows."""
        return f"target={self.targets.target!r}"


class AngleInput(InputTransform):
    r"""Replaces each angle :math:`\theta` in its place by :math:`\sin\theta, \cos\theta`.

    A stationary kernel on the result has no seam where the angle wraps.

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
        """Return the names of the columns of :meth:`transform`, of those of X."""
        columns: list[str] = []
        for i, name in enumerate(names):
            columns += [f"sin({name})", f"cos({name})"] if i in self.columns else [name]
        return columns

    @property
    def settings(self) -> dict[str, list[int]]:
        """The arguments that make it again."""
        return {"columns": [*self.columns]}

    def equals(self, other: InputTransform) -> bool:
        """Return whether ``other`` replaces the same columns."""
        return isinstance(other, AngleInput) and self.columns == other.columns


def check_spec(spec: StateSpec) -> None:
    """Raise a TypeError unless it is one."""
    check_kind("spec", spec, StateSpec, "a StateSpec, such as StateSpec(['x', 'v'], ['force'])")


def named_physics(physics: Any, spec: StateSpec) -> dict[str, Physics]:
    """Return checked physics of next states by name: one, or those of a list or mapping."""
    named: Any = physics
    if not isinstance(named, Mapping):
        several = physics if isinstance(physics, list | tuple) else [physics]
        named = {str(i + 1): each for i, each in enumerate(several)}
    parts: dict[str, Physics] = {}
    for name, each in named.items():
        part = parts[name] = as_physics(each)
        if isinstance(physics, Mapping) and part is not each:  # a wrapper of ours
            part.name = name
        if isinstance(part, ODEPhysics) and part.difference:
            raise ValueError(
                f"Physics {part.name!r} returns the change of the state (difference=True), but "
                "dynamics take the next state from it; build it with difference=False."
            )
        if part.step is None or spec.step is None:
            continue
        if not math.isclose(part.step, spec.step, rel_tol=1e-6):
            raise ValueError(
                f"Physics {part.name!r} makes steps of {part.step:g}, but the spec says "
                f"{spec.step:g}; build it with step={spec.step:g}, or correct the spec."
            )
    return parts


def one_physics(physics: Any, spec: StateSpec, otherwise: str) -> Physics:
    """Return a physics of next states; a ValueError, with the way out, unless there is one."""
    parts = [*named_physics(physics, spec).values()]
    if len(parts) != 1:
        names = ", ".join(repr(part.name) for part in parts)
        raise ValueError(f"Expected one physics to follow, got {names}; {otherwise}.")
    return parts[0]


def next_values(
    physics: Physics, spec: StateSpec, states: Tensor, actions: Tensor, parameters: Any = None
) -> Tensor:
    """Return the next states ``... x state_dim`` by a physics, of which exogenous ones stay."""
    inputs, following = spec.physics_inputs(states, actions), states.clone()
    Y = physics(inputs if inputs.dim() > 1 else inputs.unsqueeze(0), parameters)
    check_next_values(physics, Y, len(spec.moving))
    following[..., spec.moving] = Y
    return spec.remember(following, states, actions)


def check_next_values(physics: Physics, Y: Tensor, num_states: int) -> None:
    """Raise a ValueError unless the physics has returned as many columns as there are states."""
    if Y.shape[-1] != num_states:
        raise ValueError(
            f"Expected physics {physics.name!r} to return the next values of the {num_states} "
            f"states that are neither exogenous nor previous values, got {Y.shape[-1]} columns."
        )


def warn_of_differences(name: str, spec: StateSpec, data: Trajectories, following: Tensor) -> None:
    """Warn if what a physics returned is a third as far off as changes, in their units, or less."""
    scale = spec.change(data.states, data.next_states).square().nanmean(0).sqrt()
    columns, errors = [i for i in spec.moving if scale[i] > 0], []
    for predicted in (following, data.states + following):
        error = spec.change(data.next_states, predicted) / scale
        errors.append(float(error[:, columns].square().nansum().sqrt()))
    if errors[1] < errors[0] / 3:
        warnings.warn(
            f"Physics {name!r} seems to return the change of the state, but dynamics take the next "
            f"state from it. As a change, its error is {errors[1] / errors[0]:.2g} times that of "
            "the next state. Let it return `next state = state + change`.",
            UserWarning,
            stacklevel=4,
        )


def checked_physics_error(spec: StateSpec, errors: Mapping[str, float] | None) -> dict[str, float]:
    """Return standard deviations of the error of a step of the physics, by state."""
    moving = [spec.states[i] for i in spec.moving]
    for name, sd in (errors or {}).items():
        if name not in moving:
            raise ValueError(f"physics_error is of states among {moving}; found {name!r}.")
        checked_number(f"physics_error[{name!r}]", sd, least=0)
    return {**(errors or {})}
