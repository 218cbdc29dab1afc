"""The subject of a report: a model, a mixture or a comparison, in one form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core import GP, StackedGP
from gpadjust.kinds.ar1 import AR1
from gpadjust.kinds.categories import Categories
from gpadjust.physics import Physics
from gpadjust.validation import Comparison, LeaveOneOut, leave_one_out
from gpadjust.validation.plots import column
from gpadjust.validation.trust import physics_at


@dataclass(frozen=True)
class Origin:
    """Origin of a page, as far as its subject does not know it."""

    settings: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  # on the data
    notes: tuple[str, ...] = ()  # on the fit, such as warnings
    how: str = "report(compare(train_X, train_Y, physics))"  # compares a model with others
    physics: str = ""  # Python code of the physics, unless the model's file holds it or its name
    modules: tuple[str, ...] = ()  # that this code needs
    units: Mapping[str, str] = field(default_factory=dict)  # of a log's states, actions and "time"
    program: str = ""  # that identifies the machine of a log in Python, and goes on


class Adjusted(NamedTuple):
    """A model of one structure, whose rho, delta and trust are shown for an output."""

    structure: str
    model: GP
    weight: float  # in a mixture; 1 if there is none


@dataclass(frozen=True)
class Subject:
    """The subject of a report: a model, a mixture of several, or what a comparison recommends."""

    model: GP | StackedGP
    comparison: Comparison | None
    inputs: tuple[str, ...]  # their names
    outputs: tuple[str, ...]
    X: Tensor  # n x d
    Y: Tensor  # n x m, NaN where there is no observation
    loo: LeaveOneOut
    rows: list[str]  # their names
    adjusted: list[Adjusted | None]  # of each output; None if no physics is adjusted
    physics: dict[str, Physics]  # by their names
    has_physics: bool  # AR1 knows its physics through samples alone
    judged: Tensor  # observations that errors and coverage are of, NaN where it is an outlier
    base: Tensor  # medians of the inputs, d, for slices; of categories a level
    levels: dict[int, tuple[str, ...]]  # names of categories, by column; their numbers are from 0
    batches: list[int]  # columns of batches

    def outliers(self, output: int) -> list[str]:
        """Return the names of the rows whose observation of an output counts as an outlier."""
        is_out = self.Y[:, output].isfinite() & self.judged[:, output].isnan()
        return [self.rows[i] for i in is_out.nonzero().flatten().tolist()]

    def physics_at(self, X: Tensor, output: int) -> dict[str, Tensor]:
        """Return an output of each physics that is shown, ``n``."""
        shown = self.adjusted[output]
        values = {} if shown is None else physics_at(shown.model, X)
        return {name: column(f, output) for name, f in values.items()}


def subject_of(thing: object, rows: Sequence[object] | None = None) -> Subject:
    """Return the subject that a model, a mixture or a comparison is; rows have numbers or names."""
    comparison = thing if isinstance(thing, Comparison) else None
    model = comparison.recommended if comparison is not None else thing
    if not isinstance(model, GP | StackedGP):
        raise TypeError(
            "Expected a fitted model of gpadjust, a StackedGP, or a Comparison (which `compare` "
            f"makes); found {type(thing).__name__}. Of many rows report on `gpadjust.compare` of "
            "some hundred."
        )
    if isinstance(model, GP) and not model.is_fitted:
        raise ValueError(
            f"Expected a fitted model; found {model!r}: call `gpadjust.fit(model)` first. To learn "
            "whether the physics helps, report on `gpadjust.compare(train_X, train_Y, physics)`."
        )
    X, Y = model.data.X, model.data.Y
    loo = leave_one_out(model) if comparison is None else comparison.leave_one_out()
    names = [f"row {i}" for i in range(len(X))] if rows is None else [str(row) for row in rows]
    if len(names) != len(X):
        raise ValueError(f"Expected {len(X)} names of rows, one for each, found {len(names)}.")
    if comparison is not None:
        models: Sequence[GP] = [*comparison.models.values()]
    else:
        models = model.models if isinstance(model, StackedGP) else [model]
    physics = {part.name: part for each in models for part in each.physics}
    has_physics = bool(physics) or any(isinstance(each, AR1) for each in models)
    adjusted = [_adjusted(model, comparison, j) for j in range(Y.shape[-1])]
    judged = Y if loo.is_outlier is None else Y.masked_fill(loo.is_outlier, torch.nan)
    transform, base = model.data.transform, X.quantile(0.5, dim=0)
    levels: dict[int, tuple[str, ...]] = {}
    if isinstance(transform, Categories):
        columns = [*transform.levels]
        base[columns] = X.median(0).values[columns]
        texts = {i: tuple(map(str, own)) for i, own in transform.levels.items()}
        levels = {i: own for i, own in texts.items() if own == transform.levels[i]}
    batches = transform.batches if isinstance(transform, Categories) else []
    return Subject(
        model, comparison, model.data.input_names, model.data.output_names, X, Y, loo, names,
        adjusted, physics, has_physics, judged, base, levels, batches,
    )  # fmt: skip


def _adjusted(model: GP | StackedGP, comparison: Comparison | None, output: int) -> Adjusted | None:
    """Return the structure of most weight that adjusts a physics, of what predicts an output."""
    if comparison is not None:
        rows = [*comparison.table.values()][output]
        models = comparison.models
        ranked = [(row.structure, row.weight) for row in rows if row.structure in models]
        candidates = [(name, models[name], weight) for name, weight in ranked]
    elif isinstance(model, StackedGP):
        weights = zip(model.weights.items(), model.models, strict=True)
        candidates = [(name, part, own[output]) for (name, own), part in weights]
    else:
        candidates = [(type(model).__name__, model, 1.0)]
    for name, part, weight in sorted(candidates, key=lambda candidate: -candidate[2]):
        if isinstance(part, GP) and part.physics:
            return Adjusted(name, part, weight)
    return None
