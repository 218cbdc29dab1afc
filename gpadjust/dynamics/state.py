"""Dynamics in plain values: what they are, what they learnt, and whether a physics is the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from types import FunctionType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics.trajectories import Trajectories
from gpadjust.states import StateSpec

COLUMNS = ("states", "actions", "next_states")  # of transitions in a state
_PROBES = 3
_OF_SPREAD = 1e-4  # of what the physics says, by which another machine's may differ
_OF_SIZE = 1e-6  # of the states that it is computed from


def fingerprint(kind: type, spec: StateSpec, **settings: Any) -> dict[str, str]:
    """Class, spec and settings of dynamics, each as a text.

    A setting that is a mapping counts by its items. Modules and other objects that have no value to
    compare are named by their class, classes and functions by their name.
    """
    settings = {**asdict(spec), **settings}
    return {"class": kind.__name__, **{name: _text(value) for name, value in settings.items()}}


def check_fingerprint(state: dict[str, Any], expected: dict[str, str]) -> None:
    """Raise a RuntimeError, as PyTorch does, if a state is of other dynamics.

    The state of dynamics that learnt nothing is empty, and fits all.

    Raises:
        TypeError: If it is no dictionary.
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
    """A few transitions, and what a physics says of them.

    Args:
        states: ``k x state_dim``.
        actions: ``k x action_dim``.
        values: ``k x m``.
        tolerance: By how much the same physics may differ, ``m``.
    """

    states: Tensor
    actions: Tensor
    values: Tensor
    tolerance: Tensor

    @classmethod
    def of(
        cls, states: Tensor, actions: Tensor, values: Tensor, columns: list[int]
    ) -> PhysicsProbes:
        """At most 3 of ``N`` rows: of each third that where the physics says what is least usual.

        Args:
            states: ``N x state_dim``.
            actions: ``N x action_dim``.
            values: What the physics says of some states, ``N x m``.
            columns: Which states, ``m``.
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
        """Take probes from a state.

        Raises:
            RuntimeError: If they are none.
        """
        widths = (spec.state_dim, spec.action_dim, num_values)
        whole = isinstance(given, list | tuple) and all(map(torch.is_tensor, given))
        k = given[0].shape[:1] if whole and given else ()
        expected = [*((*k, width) for width in widths), (num_values,)]
        if not whole or expected != [tuple(t.shape) for t in given if t.dtype == torch.float64]:
            raise RuntimeError(
                "The state is damaged: expected 'probes' as float64 tensors of k rows each, with "
                f"{widths} columns, and {num_values} tolerances."
            )
        return cls(*(tensor.clone() for tensor in given))

    def check(self, found: Tensor, physics: str, spec: StateSpec, columns: list[int]) -> None:
        """Raise a RuntimeError, as PyTorch does of a state, if a physics says something else.

        Args:
            found: What it says, ``k x m``.
            physics: Its name.
            spec: What the entries of the state are.
            columns: Which states these are, ``m``.
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


class LearntState(NamedTuple):
    """State of :class:`LearnedDynamics`: as :class:`Learnt`, with that of the fitted model."""

    data: Trajectories
    known: Tensor | None
    chunks: tuple[int, ...]
    searched_at: int
    parameters: dict[str, Tensor]

    @classmethod
    def checked(cls, state: Mapping[str, Any], spec: StateSpec, num_known: int) -> LearntState:
        """Take a state, whose tensors are copied.

        Args:
            state: The state.
            spec: What the entries of states and actions are.
            num_known: The number of columns of what the physics says, 0 without one.

        Raises:
            RuntimeError: If something is missing, or not what it should be.
        """
        for name in ("transitions", "physics", "chunks", "searched_at", "model"):
            if name not in state:
                raise RuntimeError(f"The state is damaged: it lacks {name!r}.")
        given, known, parameters = state["transitions"], state["physics"], state["model"]

        def expect(right: bool, name: str, expected: str) -> None:
            if not right:
                raise RuntimeError(f"The state is damaged: expected {name!r} as {expected}.")

        whole = isinstance(given, Mapping) and {*given} == {*COLUMNS}
        expect(whole, "transitions", f"a dictionary of {', '.join(COLUMNS)}")
        try:
            data = Trajectories.checked(spec, **given)
        except (TypeError, ValueError) as error:
            raise RuntimeError(f"The state is damaged in its transitions. {error}") from error
        n = len(data.states)
        if (known is None) != (num_known == 0):
            there, here = ("out", "one") if known is None else ("", "none")
            raise RuntimeError(
                f"The state is of dynamics with{there} a physics, but there is {here} here. Load "
                "it into dynamics built as they were."
            )
        if known is not None:
            whole = torch.is_tensor(known) and known.dtype == torch.float64
            whole = whole and known.shape == (n, num_known) and bool(known.isfinite().all())
            expect(whole, "physics", f"finite float64 values of shape {(n, num_known)}")
            known = known.clone()
        chunks, searched_at = state["chunks"], state["searched_at"]
        for size in [*chunks] if isinstance(chunks, list | tuple) else [None]:
            whole = isinstance(size, int) and 1 <= size <= n
            expect(whole, "chunks", f"numbers of transitions, {n} in all")
        expect(sum(chunks) == n, "chunks", f"numbers of transitions, {n} in all")
        whole = isinstance(searched_at, int) and 1 <= searched_at <= n
        expect(whole, "searched_at", f"a number of transitions, at most {n}")
        whole = isinstance(parameters, Mapping) and all(map(torch.is_tensor, parameters.values()))
        whole = whole and not any(tensor.isnan().any() for tensor in parameters.values())
        expect(whole, "model", "a dictionary of tensors without NaN")
        return cls(data, known, tuple(chunks), searched_at, dict(parameters))


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
