"""Targets of a model that stand for next states, and the physics in their form."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from gpadjust.checks import check_choice, checked_number
from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.physics import ODEPhysics, ParameterValues, Physics, PhysicsError, as_physics
from gpadjust.physics.black_box import RowMemo, row_keys
from gpadjust.states import StateSpec
from gpadjust.states.state_spec import side_by_side, some_columns

Target = Literal["difference", "absolute"]
_ALL = 2**62  # rows that a memo holds


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

    Memory, batching and gradients are those of the physics itself. The values at the training
    inputs can be given, so that a simulator need not run again when a model is loaded.
    """

    def __init__(self, physics: Physics, targets: Targets) -> None:
        super().__init__(unknowns=physics.unknowns, name=physics.name)
        self.physics = physics
        self.targets = targets
        self.num_outputs = len(targets.predicted)
        self.known = RowMemo(_ALL)

    def evaluate(self, X: Tensor, *parameters: ParameterValues) -> Tensor:
        """The targets that the physics stands for, ``N x m``."""
        return self._targets_of(self.physics.of_rows, X, *parameters)

    def _targets_of(
        self, ask: Callable[[Tensor], Tensor], X: Tensor, *parameters: ParameterValues
    ) -> Tensor:
        """The targets by what the physics is asked of its rows."""
        targets = self.targets
        num_states = len(targets.spec.moving)
        states = X[:, :num_states]
        read = some_columns(X, targets.of_physics)
        try:
            following = ask(self.physics.read_rows(read, *parameters))
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

    def know(self, X: Tensor, values: Tensor) -> None:
        """Take the values at inputs ``N x d`` as given; they replace those known so far."""
        self.known = RowMemo(_ALL)
        self.known.store(row_keys(X), values)

    def forget(self) -> None:
        """Forget what was given, and what the physics remembers."""
        self.known = RowMemo(_ALL)
        self.physics.forget()

    def of_rows(self, rows: Tensor) -> Tensor:
        """Like the base class; values that were given are not asked for again."""
        asks = torch.is_grad_enabled() and rows.requires_grad
        if asks or not len(self.known) or self.unknowns:
            return super().of_rows(rows)
        return self.known.recall(rows, super().of_rows, learn=False)

    def fresh_rows(self, rows: Tensor) -> Tensor:
        """Like :meth:`of_rows`, evaluated whatever was given or is remembered."""
        return self._targets_of(self.physics.fresh_rows, *self._arguments(rows))

    def extra_repr(self) -> str:
        """The settings that ``repr`` shows."""
        return f"target={self.targets.target!r}"

    def __getstate__(self) -> dict[str, Any]:
        """All but what is known, which belongs to the data."""
        return {**self.__dict__, "known": RowMemo(_ALL)}


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
