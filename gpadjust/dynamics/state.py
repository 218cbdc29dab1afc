"""Dynamics in plain values: what they are, what they learnt, and whether a physics is the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from types import FunctionType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.states import StateSpec

_COLUMNS = ("states", "actions", "next_states")  # of transitions in a state
_PROBES = 3
_OF_SPREAD = 1e-4  # of what the physics says, by which another machine's may differ
_OF_SIZE = 1e-6  # of the states that it is computed from


def fingerprint(kind: type, spec: StateSpec, **settings: Any) -> dict[str, str]:
    """Class, spec and settings of dynamics, each as a text.

    A setting that is a mapping counts by its items. Modules and other objects that have no value to
    compare are named by their class, classes and functions by their name.
    """
    # Where nothing is integrated, the step is but the unit of horizons.
    step = spec.step if spec.integrated else None
    settings = {**asdict(spec), "step": step, **settings}
    return {"class": kind.__name__, **{name: _text(value) for name, value in settings.items()}}


def check_fingerprint(state: dict[str, Any], expected: dict[str, str]) -> None:
    """Raise a RuntimeError, as PyTorch does, if a state is of other dynamics.

    The state of dynamics that learnt nothing is empty, and fits all.
    """
    if not isinstance(state, Mapping):
        raise TypeError(f"Expected a dictionary that `state_dict` gave, found {state!r}.")
    if not state:
        return
    found = state.get("fingerprint")
    if not isinstance(found, Mapping):
        raise RuntimeError(
            "The state does not say of what dynamics it is; expected one that `state_dict` gave, "
            f"with a 'fingerprint'. It holds {sorted(map(str, state))}."
        )
    names = [name for name in {**expected, **found} if found.get(name) != expected.get(name)]
    if names:
        different = "; ".join(
            f"{name} is {found.get(name, 'missing')} in the state, {expected.get(name, 'missing')} "
            "here"
            for name in names
        )
        raise RuntimeError(
            f"The state is of {found.get('class')} with other settings than this "
            f"{expected['class']}: {different}. Load it into dynamics built as they were."
        )


class PhysicsProbes(NamedTuple):
    """A few transitions, and what a physics says of them."""

    states: Tensor  # k x state_dim
    actions: Tensor  # k x action_dim
    values: Tensor  # k x m
    tolerance: Tensor  # by how much the same physics may differ, m

    @classmethod
    def of(
        cls, states: Tensor, actions: Tensor, values: Tensor, columns: list[int]
    ) -> PhysicsProbes:
        """At most 3 of ``N`` rows: of each third that where the physics says what is least usual.

        It says values, ``N x m``, of the states in these columns.
        """
        departure = (values - values.mean(0)).abs()
        spread = departure.square().mean(0).sqrt()
        unusual = (departure / spread.clamp_min(torch.finfo(spread.dtype).tiny)).amax(-1)
        rows = torch.arange(len(values)).tensor_split(_PROBES)
        chosen = torch.stack([some[unusual[some].argmax()] for some in rows if len(some)])
        size = torch.cat([states[:, columns], values]).abs().amax(0)
        tolerance = _OF_SPREAD * spread + _OF_SIZE * size
        return cls(states[chosen], actions[chosen], values[chosen], tolerance)

    @classmethod
    def checked(cls, given: Any, spec: StateSpec, num_values: int) -> PhysicsProbes:
        """Take probes from a state; a RuntimeError if they are none."""
        expect(
            isinstance(given, list | tuple) and len(given) > 0,
            "probes",
            "a list of float64 tensors",
        )
        k = len(given[0]) if torch.is_tensor(given[0]) and given[0].dim() else 0
        widths = (spec.state_dim, spec.action_dim, num_values)
        return cls(*copies(given, "probes", *((k, width) for width in widths), (num_values,)))

    def check(self, found: Tensor, physics: str, spec: StateSpec, columns: list[int]) -> None:
        """Raise a RuntimeError, as PyTorch does of a state, if a physics found something else.

        It is ``k x m``, of the states in these columns.
        """
        names = [spec.states[i] for i in columns]
        gap = found - self.values
        for i in (i for i, name in enumerate(names) if name in spec.angles):
            gap[:, i] = torch.atan2(gap[:, i].sin(), gap[:, i].cos())
        excess = gap.abs() - self.tolerance
        if (excess <= 0).all():
            return
        row, column = divmod(int(excess.argmax()), excess.shape[-1])
        raise RuntimeError(
            f"The state is of dynamics with another physics than {physics!r} here. In the state "
            f"{self.states[row].tolist()}, after the action {self.actions[row].tolist()}, that "
            f"one said {float(self.values[row, column]):.6g} of {names[column]!r}, this one says "
            f"{float(found[row, column]):.6g}. Load the state into dynamics of the physics that it "
            "was learnt with, or learn from its transitions again. A physics that is not "
            "deterministic looks the same: dynamics need one that says the same each time."
        )


def expect(right: bool, name: str, expected: str) -> None:
    """Raise a RuntimeError, as PyTorch does, unless a part of a state is right."""
    if not right:
        raise RuntimeError(f"The state is damaged: expected {name!r} as {expected}.")


def copies(given: Sequence[Any], name: str, *shapes: tuple[int, ...]) -> list[Tensor]:
    """Copies of finite float64 tensors of these shapes; a RuntimeError if they are none."""
    found = [tuple(t.shape) for t in given if torch.is_tensor(t) and t.dtype == torch.float64]
    whole = (
        len(found) == len(given) and found == [*shapes] and all(t.isfinite().all() for t in given)
    )
    expect(whole, name, f"finite float64 values of shape {' and '.join(map(str, shapes))}")
    return [tensor.clone() for tensor in given]


def saved(data: Trajectories) -> dict[str, Tensor]:
    """Transitions as a state has them, without episodes."""
    return {name: tensor.clone() for name, tensor in zip(_COLUMNS, data, strict=True)}


def loaded(given: Any, spec: StateSpec) -> Trajectories:
    """Copies of the transitions of a state; a RuntimeError if they are damaged."""
    whole = isinstance(given, Mapping) and {*given} == {*_COLUMNS}
    expect(whole, "transitions", f"a dictionary of {', '.join(_COLUMNS)}")
    try:
        return Trajectories.checked(spec, **given)
    except (TypeError, ValueError) as error:
        raise RuntimeError(f"The state is damaged in its transitions. {error}") from error


def _text(value: Any) -> str:
    """The value of plain objects, the class of others."""
    if isinstance(value, Mapping):
        items = sorted((str(key), _text(part)) for key, part in value.items())
        return "{" + ", ".join(f"{key!r}: {part}" for key, part in items) + "}"
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(_text(part) for part in value) + ")"
    if isinstance(value, float):
        return repr(float(value))  # NumPy's print their type
    if value is None or isinstance(value, (bool, int, str)):
        return repr(value)
    named = isinstance(value, (type, FunctionType))
    return value.__name__ if named else f"<{type(value).__name__}>"
