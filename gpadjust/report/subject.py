"""The subject of a report: a model, a mixture or a comparison, in one form."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core import GP, StackedGP
from gpadjust.kinds.ar1 import AR1
from gpadjust.kinds.categories import Categories, levels_of
from gpadjust.physics import Physics
from gpadjust.validation import Comparison, LeaveOneOut, leave_one_out
from gpadjust.validation.leave_one_out import observations
from gpadjust.validation.plots.adjustments import adjustments_of
from gpadjust.validation.plots.drawing import column
from gpadjust.validation.plots.predictions import physics_at


class Adjusted(NamedTuple):
    """A model of one structure, whose rho, delta and trust are shown for an output.

    Attributes:
        structure: The name of the structure.
        model: The model.
        output: Which of its outputs.
        weight: Its weight in a mixture; 1 if there is none.
    """

    structure: str
    model: GP
    output: int
    weight: float

    @property
    def terms(self) -> list[str]:
        """The names of rho and delta, as far as the model has them."""
        return adjustments_of(self.model)


@dataclass(frozen=True)
class Subject:
    """The subject of a report.

    Attributes:
        model: The model that predicts, or a mixture of several.
        comparison: The comparison that recommends it, if there is one.
        X: Inputs of the observations, ``n x d``.
        Y: Observations, ``n x m``, NaN where there is none.
        loo: Predictions of left-out observations.
        rows: The name of each row, ``n``.
        adjusted: For each output what is shown of rho and delta; None if no physics is adjusted.
    """

    model: GP | StackedGP
    comparison: Comparison | None
    X: Tensor
    Y: Tensor
    loo: LeaveOneOut
    rows: list[str]
    adjusted: list[Adjusted | None]

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of the inputs."""
        return self.model.data.input_names

    @property
    def outputs(self) -> tuple[str, ...]:
        """The names of the outputs."""
        return self.model.data.output_names

    @property
    def counts(self) -> list[int]:
        """The number of observations of each output, without outliers."""
        counts: list[int] = (~self.judged.isnan()).sum(0).tolist()
        return counts

    @property
    def judged(self) -> Tensor:
        """Observations that errors and coverage are of, ``n x m``, NaN where it is an outlier."""
        outlier = self.loo.is_outlier
        return self.Y if outlier is None else self.Y.masked_fill(outlier, torch.nan)

    def outliers(self, output: int) -> list[str]:
        """Return the names of the rows whose observation of an output counts as an outlier."""
        outlier = self.loo.is_outlier
        if outlier is None:
            return []
        return [self.rows[i] for i in outlier[:, output].nonzero().flatten().tolist()]

    @property
    def names(self) -> dict[int, tuple[str, ...]]:
        """The names of the categories that are texts, by their column; their numbers are from 0."""
        levels = levels_of(self.model).items()
        texts = {i: tuple(str(name) for name in own) for i, own in levels}
        return {i: texts[i] for i, own in levels if own == texts[i]}

    @property
    def batches(self) -> list[int]:
        """The columns of batches."""
        transform = self.model.data.transform
        return transform.batches if isinstance(transform, Categories) else []

    @property
    def base(self) -> Tensor:
        """The medians of the inputs, ``d``, for slices; of categories a level."""
        middle, level = self.X.quantile(0.5, dim=0), self.X.median(0).values
        levels = levels_of(self.model)
        which = [i in levels for i in range(len(middle))]
        return level.where(torch.tensor(which), middle)

    @property
    def physics(self) -> dict[str, Physics]:
        """The physics by their names."""
        return {part.name: part for model in self._models() for part in model.physics}

    @property
    def has_physics(self) -> bool:
        """Whether there is a physics; AR1 knows it through samples alone."""
        return bool(self.physics) or any(isinstance(model, AR1) for model in self._models())

    @property
    def as_it_is(self) -> str:
        """Description of the unadjusted physics."""
        unknown = any(physics.unknowns for physics in self.physics.values())
        return "with fitted parameters" if unknown else "as it is"

    def physics_at(self, X: Tensor, output: int) -> dict[str, Tensor]:
        """Return an output of each physics that is shown, ``n``."""
        shown = self.adjusted[output]
        if shown is None:
            return {}
        return {name: column(f, output) for name, f in physics_at(shown.model, X).items()}

    def _models(self) -> Iterator[GP]:
        if self.comparison is not None:
            yield from self.comparison.models.values()
        elif isinstance(self.model, StackedGP):
            yield from self.model.models
        else:
            yield self.model


def subject_of(thing: object, rows: Sequence[object] | None = None) -> Subject:
    """Return the subject that a model, a mixture of models, or a comparison is.

    Args:
        thing: One of these.
        rows: Names of the rows of its data. Default: by their numbers, from 0.

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
    adjusted = [_adjusted(model, comparison, j) for j in range(Y.shape[-1])]
    return Subject(model, comparison, X, Y, loo, names, adjusted)


def _adjusted(model: GP | StackedGP, comparison: Comparison | None, output: int) -> Adjusted | None:
    """Return the structure of most weight that adjusts a physics, of what predicts an output."""
    candidates = [(type(model).__name__, model, 1.0)]
    if comparison is not None:
        rows = [*comparison.table.values()][output]
        candidates = [(r.structure, comparison.models[r.structure], r.weight) for r in rows]
    elif isinstance(model, StackedGP):
        weights = zip(model.weights.items(), model.models, strict=True)
        candidates = [(name, each, own[output]) for (name, own), each in weights]
    for name, each, weight in sorted(candidates, key=lambda each: -each[2]):
        if isinstance(each, GP) and each.physics:
            return Adjusted(name, each, output, weight)
    return None
