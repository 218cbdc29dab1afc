"""The subject of a report: a model, a mixture or a comparison, in one form."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.gp import PhysicsInput
from gpadjust.models import AR1, StackedGP, TermsGP, VariationalCKA
from gpadjust.physics import JoinedPhysics, Physics
from gpadjust.validation import Comparison, LeaveOneOut, leave_one_out
from gpadjust.validation.leave_one_out import observations
from gpadjust.validation.plots.drawing import column
from gpadjust.validation.plots.predictions import physics_curves


class Adjusted(NamedTuple):
    """A model of one structure, whose rho, delta and trust are shown for an output.

    Attributes:
        structure: The name of the structure.
        model: The model.
        output: Which of its outputs.
        weight: Its weight in a mixture; 1 if there is none.
    """

    structure: str
    model: TermsGP
    output: int
    weight: float

    @property
    def terms(self) -> tuple[str, ...]:
        """The names of rho and delta, as far as the model has them."""
        return tuple(name for name in self.model.term_names if name != "f")


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

    model: TermsGP | StackedGP
    comparison: Comparison | None
    X: Tensor
    Y: Tensor
    loo: LeaveOneOut
    rows: list[str]
    adjusted: list[Adjusted | None]

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of the inputs."""
        return tuple(self.model.input_names)

    @property
    def outputs(self) -> tuple[str, ...]:
        """The names of the outputs."""
        return tuple(self.model.output_names)

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
        """The names of the rows whose observation of an output counts as an outlier."""
        outlier = self.loo.is_outlier
        if outlier is None:
            return []
        return [self.rows[i] for i in outlier[:, output].nonzero().flatten().tolist()]

    @property
    def names(self) -> dict[int, tuple[str, ...]]:
        """The names of the categories that are texts, by their column; their numbers are from 0."""
        levels = self.model.levels.items()
        return {i: (*own,) for i, own in levels if all(isinstance(name, str) for name in own)}

    @property
    def base(self) -> Tensor:
        """The medians of the inputs, ``d``, for slices; of categories a level."""
        middle, level = self.X.quantile(0.5, dim=0), self.X.median(0).values
        which = [i in self.model.levels for i in range(len(middle))]
        return level.where(torch.tensor(which), middle)

    @property
    def physics(self) -> dict[str, Physics]:
        """The physics by their names."""
        found: dict[str, Physics] = {}
        for model in self._models():
            transform: Any = getattr(model, "input_transform", None)
            if isinstance(transform, PhysicsInput):
                given: Any = transform.physics
                several = isinstance(given, JoinedPhysics)
                found |= (
                    zip(given.names, given.parts, strict=True) if several else {given.name: given}
                )
        return found

    @property
    def is_sampled(self) -> bool:
        """True if the physics is known through samples alone, as AR1 has it."""
        return any(isinstance(model, AR1) for model in self._models())

    @property
    def as_it_is(self) -> str:
        """Description of the unadjusted physics."""
        unknown = any(physics.unknowns for physics in self.physics.values())
        return "with fitted parameters" if unknown else "as it is"

    def physics_at(self, X: Tensor, output: int) -> list[tuple[str, Tensor]]:
        """Values of an output by each physics shown, ``n``, parameters at their means."""
        shown = self.adjusted[output]
        if shown is None:
            return []
        with torch.no_grad():
            curves = physics_curves(shown.model)
            return [(name, column(f_p(X), output)) for name, f_p in curves]

    def _models(self) -> Iterator[TermsGP]:
        if self.comparison is not None:
            yield from self.comparison.models.values()
        elif isinstance(self.model, StackedGP):
            yield from (part.model for parts in self.model.parts for part in parts)
        else:
            yield self.model


def subject_of(thing: object, rows: Sequence[object] | None = None) -> Subject:
    """The subject that a model, a mixture of models, or a comparison is.

    Args:
        thing: One of these.
        rows: Names of the rows of its data. Default: by their numbers, from 0.

    Raises:
        TypeError: If it is none of these.
        ValueError: If it was not fitted, is of a batch of data sets, or ``rows`` are not as many as
            those of its data.
    """
    comparison = thing if isinstance(thing, Comparison) else None
    model = comparison.recommended if comparison is not None else thing
    if isinstance(model, VariationalCKA):
        raise TypeError(
            "VariationalCKA has no leave-one-out predictions, expected a model that has: report "
            "on `gpadjust.compare` of some hundred of its rows."
        )
    if not isinstance(model, TermsGP | StackedGP):
        raise TypeError(
            "Expected a fitted model of gpadjust, a StackedGP, or a Comparison (which `compare` "
            f"makes), got {type(thing).__name__}."
        )
    if isinstance(model, TermsGP):
        if model.batch_shape and model.num_samples is None:
            raise ValueError(
                f"Expected a model of one data set, got one of batch_shape "
                f"{tuple(model.batch_shape)}; report on the data sets one by one."
            )
        if not model.is_fitted:
            raise ValueError(
                f"{model!r} was not fitted: call `gpadjust.fit(model)` first. To learn whether the "
                "physics helps, report on `gpadjust.compare(train_X, train_Y, physics)`."
            )
    X, Y = observations(model)
    if comparison is not None and comparison.left_out:
        loo = comparison.leave_one_out()
    else:
        loo = leave_one_out(model)
    names = [f"row {i}" for i in range(len(X))] if rows is None else [str(row) for row in rows]
    if len(names) != len(X):
        raise ValueError(f"Expected {len(X)} names of rows, one for each, got {len(names)}.")
    adjusted = [_adjusted(model, comparison, j) for j in range(Y.shape[-1])]
    return Subject(model, comparison, X, Y, loo, names, adjusted)


def _adjusted(
    model: TermsGP | StackedGP, comparison: Comparison | None, output: int
) -> Adjusted | None:
    """The structure of most weight that adjusts a physics, of what predicts an output."""
    candidates: list[tuple[str, TermsGP, int, float]]
    if comparison is not None:
        rows = [*comparison.table.values()][output]
        ranked = sorted(rows, key=lambda row: -row.weight)
        candidates = [
            (row.structure, comparison.models[row.structure], output, row.weight) for row in ranked
        ]
    elif isinstance(model, StackedGP):
        total = model.num_samples
        parts = sorted(model.parts[output], key=lambda part: -part.number)
        candidates = [(part.name, part.model, 0, part.number / total) for part in parts]
    else:
        candidates = [(type(model).__name__, model, output, 1.0)]
    for name, each, j, weight in candidates:
        if isinstance(each, TermsGP) and each.rho_names:
            return Adjusted(name, each, j, weight)
    return None
