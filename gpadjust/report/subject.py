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
from gpadjust.validation.leave_one_out import observations
from gpadjust.validation.plots.drawing import column
from gpadjust.validation.plots.predictions import physics_at


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
    output: int
    weight: float  # in a mixture; 1 if there is none


@dataclass(frozen=True)
class Subject:
    """The subject of a report: a model, a mixture of several, or what a comparison recommends."""

    model: GP | StackedGP
    comparison: Comparison | None
    X: Tensor  # n x d
    Y: Tensor  # n x m, NaN where there is no observation
    loo: LeaveOneOut
    rows: list[str]  # their names
    adjusted: list[Adjusted | None]  # of each output; None if no physics is adjusted
    physics: dict[str, Physics]  # by their names
    has_physics: bool  # AR1 knows its physics through samples alone
    categories: Categories | None  # and batches, among the inputs

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of the inputs."""
        return self.model.data.input_names

    @property
    def outputs(self) -> tuple[str, ...]:
        """The names of the outputs."""
        return self.model.data.output_names

    @property
    def judged(self) -> Tensor:
        """Observations that errors and coverage are of, ``n x m``, NaN where it is an outlier."""
        outlier = self.loo.is_outlier
        return self.Y if outlier is None else self.Y.masked_fill(outlier, torch.nan)

    def outliers(self, output: int) -> list[str]:
        """Return the names of the rows whose observation of an output counts as an outlier."""
        outlier = self.loo.is_outlier
        places = [] if outlier is None else outlier[:, output].nonzero().flatten().tolist()
        return [self.rows[i] for i in places]

    @property
    def names(self) -> dict[int, tuple[str, ...]]:
        """The names of categories that are texts, by their column; their numbers are from 0."""
        levels = {} if self.categories is None else self.categories.levels
        texts = {i: tuple(map(str, own)) for i, own in levels.items()}
        return {i: texts[i] for i, own in levels.items() if own == texts[i]}

    @property
    def base(self) -> Tensor:
        """The medians of the inputs, ``d``, for slices; of categories a level."""
        levels = {} if self.categories is None else self.categories.levels
        is_level = torch.tensor([i in levels for i in range(len(self.inputs))])
        return self.X.median(0).values.where(is_level, self.X.quantile(0.5, dim=0))

    def physics_at(self, X: Tensor, output: int) -> dict[str, Tensor]:
        """Return an output of each physics that is shown, ``n``."""
        shown = self.adjusted[output]
        values = {} if shown is None else physics_at(shown.model, X)
        return {name: column(f, output) for name, f in values.items()}


def subject_of(thing: object, rows: Sequence[object] | None = None) -> Subject:
    """Return the subject that a model, a mixture or a comparison is; rows have numbers or names.

    Raises:
        TypeError: If it is none of these.
        ValueError: If it was not fitted, or ``rows`` are not as many as those of its data.
    """
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
    X, Y = observations(model)
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
    transform = model.data.transform
    categories = transform if isinstance(transform, Categories) else None
    subject = (model, comparison, X, Y, loo, names, adjusted)
    return Subject(*subject, physics, has_physics, categories)


def _adjusted(model: GP | StackedGP, comparison: Comparison | None, output: int) -> Adjusted | None:
    """Return the structure of most weight that adjusts a physics, of what predicts an output."""
    if comparison is not None:
        rows = [*comparison.table.values()][output]
        candidates = [(row.structure, comparison.models[row.structure], row.weight) for row in rows]
    elif isinstance(model, StackedGP):
        weights = zip(model.weights.items(), model.models, strict=True)
        candidates = [(name, part, own[output]) for (name, own), part in weights]
    else:
        candidates = [(type(model).__name__, model, 1.0)]
    for name, part, weight in sorted(candidates, key=lambda candidate: -candidate[2]):
        if isinstance(part, GP) and part.physics:
            return Adjusted(name, part, output, weight)
    return None
