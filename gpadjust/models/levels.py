"""Levels of categorical inputs: found in data, and as numbers in tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

Levels = dict[int, tuple[Any, ...]]
"""The levels of categorical columns by their numbers: texts, which tensors have the numbers of, or
numbers themselves."""

_IDS = 0.5  # levels for each row, from which on texts are no categories


def is_frame(values: Any) -> bool:
    """Return whether values are a DataFrame, whose columns may be texts."""
    return hasattr(values, "iloc") and hasattr(values, "columns")


def texts_of(frame: Any, named: Sequence[str | int] = ()) -> Levels:
    """The levels of the columns of a DataFrame that are texts or pandas categories, sorted.

    Numbers in text, and texts that differ in most rows, are none, unless the column is named.
    """
    found: Levels = {}
    for i, name in enumerate(frame.columns if is_frame(frame) else ()):
        column = frame.iloc[:, i]
        values = column.tolist()
        if not values or not all(isinstance(value, str) for value in values):
            continue
        every = column.cat.categories.tolist() if hasattr(column, "cat") else values
        levels = tuple(sorted({*every}))
        is_plain = len(levels) <= max(4, _IDS * len(values)) and not any(map(_is_number, levels))
        if is_plain or name in named or i in named:
            found[i] = levels
    return found


def coded(frame: Any, levels: Levels, batches: Sequence[int] = ()) -> Any:
    """A DataFrame with the numbers of levels in place of texts, as an array.

    A text that is no level has the number after the last in a column of ``batches``; in another it
    is a ValueError.
    """
    texts = {i: each for i, each in levels.items() if isinstance(each[0], str)}
    if not texts or not is_frame(frame) or frame.shape[-1] <= max(texts):
        return frame
    array = frame.to_numpy(dtype=object).copy()
    for i, each in texts.items():
        numbers = {text: float(k) for k, text in enumerate(each)}
        unknown = [v for v in array[:, i] if isinstance(v, str) and v not in numbers]
        if unknown and i not in batches:
            raise ValueError(
                f"Expected {frame.columns[i]} to be one of {', '.join(each)}, got {unknown[0]!r}. "
                "Of a new level nothing is known; list it beforehand, categorical={column: "
                "levels}, or take the column as batch=..., whose new levels are new offsets."
            )
        array[:, i] = [numbers.get(v, len(each)) if isinstance(v, str) else v for v in array[:, i]]
    return array


def on_levels(X: Tensor, levels: Levels) -> Tensor:
    """Inputs ``... x d`` with the nearest level in each categorical column."""
    X = X.clone()
    for i, each in values_of(levels).items():
        known = X.new_tensor(each)
        X[..., i] = known[(X[..., i : i + 1] - known).abs().argmin(-1)]
    return X


def levels_of(
    categorical: Any, batch: Any, X: Tensor, names: Sequence[str], texts: Levels
) -> tuple[Levels, list[int]]:
    """The levels of all categorical columns, and which of them are batches.

    Args:
        categorical: Names or numbers of columns, or a mapping from these to their levels.
        batch: Likewise, one or several.
        X: The inputs, ``... x n x d``.
        names: The names of the columns.
        texts: Levels that are known: declared, or of texts of a frame.
    """
    batches = [_number(each, names, "batch") for each in several(batch)]
    columns = [_number(each, names, "categorical") for each in several(categorical)]
    every = {i: tuple(X[..., i].unique().tolist()) for i in (*columns, *batches)}
    return dict(sorted({**every, **texts}.items())), batches


def declared(categorical: Any, names: Sequence[str]) -> Levels:
    """The levels that a mapping says; a ValueError if they are not different numbers or texts."""
    found: Levels = {}
    for each, own in categorical.items() if isinstance(categorical, Mapping) else ():
        i = _number(each, names, "categorical")
        found[i] = tuple(v if isinstance(v, str) else float(v) for v in own)
        kinds = {isinstance(v, str) for v in found[i]}
        if not found[i] or len({*found[i]}) < len(found[i]) or len(kinds) > 1:
            raise ValueError(f"Expected different levels of {names[i]}, got {[*own]}.")
    return found


def values_of(levels: Levels) -> dict[int, list[float]]:
    """The numbers by which tensors have the levels."""
    return {
        i: [float(k) if isinstance(v, str) else float(v) for k, v in enumerate(own)]
        for i, own in levels.items()
    }


def several(given: Any) -> list[Any]:
    """The names or numbers of columns that are given: one, several, or with their levels."""
    if given is None:
        return []
    return [given] if isinstance(given, str | int) else [*given]


def _number(given: Any, names: Sequence[str], option: str) -> int:
    """The number of a column."""
    if isinstance(given, int) and not isinstance(given, bool) and -len(names) <= given < len(names):
        return given % len(names)
    if given in names:
        return [*names].index(given)
    raise ValueError(
        f"Expected {option} as names or numbers of columns of {', '.join(names)}, got {given!r}."
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
