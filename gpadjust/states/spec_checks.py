"""Checks of a spec, and of states by it; `StateSpec` has the rules."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

from torch import Tensor


def check_exogenous(name: str, change: Tensor, rounding: Tensor) -> None:
    """Raise an error if an exogenous state changes by more than rounding does."""
    moved = (change.abs() > rounding).nonzero()
    if len(moved):
        row = int(moved[0])
        raise ValueError(
            f"State {name!r} is said to be exogenous, which stays as it is during an episode, but "
            f"it changes by {float(change[row]):.3g} in row {row}. Of a set-point that moves give "
            "the task its `reference`; else take it out of `exogenous`, so that the model predicts "
            "it, or leave out transitions from one episode into the next."
        )


def check_lags(
    previous: Mapping[str, str], states: Sequence[str], actions: Sequence[str],
    angles: Sequence[str],
) -> None:  # fmt: skip
    """Raise an error unless what each state holds is another state's or an action's earlier value.

    A state is an angle if what it holds is one, and only then.
    """
    for name, other in previous.items():
        if (other in states) == (other in actions):
            raise ValueError(
                f"previous must name a state or an action that {name!r} holds the earlier value "
                f"of; found {other!r}, which is {'both' if other in states else 'neither'}: the "
                f"states are {tuple(states)}, the actions are {tuple(actions)}."
            )
        if (name in angles) != (other in angles and other in states):
            which = (name, other) if name in angles else (other, name)
            raise ValueError(
                f"State {name!r} holds the earlier value of {other!r}, but {which[0]!r} is one of "
                f"the angles and {which[1]!r} is not; put both into `angles`, or neither."
            )
        chain = [name]
        while (held := previous.get(chain[-1])) is not None:
            if held in chain:
                raise ValueError(
                    f"previous goes round in a circle, {' -> '.join((*chain, held))}; let it end "
                    "at an action, or at a state that is not in `previous`."
                )
            chain.append(held)


def check_reads(reads: Sequence[str], states: Sequence[str], actions: Sequence[str]) -> None:
    """Raise an error unless each name that the physics reads is one state's or action's."""
    for name in reads:
        if (name in states) == (name in actions):
            raise ValueError(
                f"physics_reads must name states and actions; found {name!r}, which is "
                f"{'both' if name in states else 'neither'}: the states are {tuple(states)}, the "
                f"actions are {tuple(actions)}."
            )


def check_previous(name: str, held: str, found: Tensor, before: Tensor, off: Tensor) -> None:
    """Raise an error for the first row ``off`` where a state is ``found``, not what was before."""
    wrong = off.nonzero()
    if len(wrong):
        row = int(wrong[0])
        raise ValueError(
            f"State {name!r} is said to hold the previous {held}, but is {float(found[row]):.3g} "
            f"where that was {float(before[row]):.3g} in row {row}. Correct `previous`, or take "
            f"{name!r} out of it, so that the model predicts it."
        )


def check_integrated(
    name: str, velocity: str, step: float, velocities: tuple[Tensor, Tensor], discrepancy: Tensor,
    rounding: Tensor,
) -> None:  # fmt: skip
    """Raise an error if an integrated state follows its velocity at another rate; warn of noise.

    Of ``N`` steps the discrepancy is the change of the state less the trapezoid's, of velocities at
    the start and at the end; its error is within the rounding of single precision.
    """
    before, after = velocities
    trapezoid = step * (before + after) / 2
    way = float((step * (before.abs() + after.abs()) / 2).sum())
    way = max(way, float((trapezoid + discrepancy).abs().sum()))
    square, length = trapezoid.square().sum(), trapezoid.abs().sum()
    excess = (trapezoid * discrepancy).sum() / square
    scatter = (discrepancy - excess * trapezoid).square().sum() / (len(discrepancy) - 1)
    # Both are nan, and the comparison false, of one row or without any movement.
    systematic = float((excess.abs() - 3 * (scatter / square).sqrt()) * length)
    unavoidable = float(rounding.sum())
    total = float(discrepancy.abs().sum())
    rate = f" but moves {1 + float(excess):.3g} times as far" if square > 0 else ""
    found = (
        f"State {name!r} is said to be integrated, as {name}' = {name} + step ({velocity} + "
        f"{velocity}') / 2 with step={step:g},{rate} and differs by {total:.3g} in all, on a way "
        f"of {way:.3g}. Mend `step` or `integrated`, or take {name!r} out of `integrated`, so that "
        "the model predicts it."
    )
    if systematic > 0.1 * way + unavoidable:
        raise ValueError(found)
    if total > 0.5 * way + unavoidable:
        warnings.warn(f"{found} Noisy sensors look the same.", UserWarning, stacklevel=5)


def checked_mapping(
    value: Mapping[str, str], argument: str, other: str, example: dict[str, str]
) -> dict[str, str]:
    """The pairs of names that an argument holds, checked."""
    if not isinstance(value, Mapping):
        raise TypeError(
            f"{argument} must map the name of a state to that of {other}, such as {example}; "
            f"found {value!r}."
        )
    for name in (*value.keys(), *value.values()):
        checked_names([name], argument)
    return dict(value)


def checked_names(value: Sequence[str], argument: str) -> tuple[str, ...]:
    """The names that an argument holds, checked."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise TypeError(f"{argument} must be a sequence of names; found {value!r}.")
    for name in value:
        if not isinstance(name, str):
            raise TypeError(f"{argument} must hold names, as strings; found {name!r}.")
    if len(set(value)) < len(value):
        raise ValueError(f"{argument} must be different names; found {tuple(value)}.")
    return tuple(value)
