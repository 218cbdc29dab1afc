"""The subject of a report: a model, a mixture or a comparison, in one form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor

from gpadjust.core import GP, StackedGP
from gpadjust.kinds.ar1 import AR1
from gpadjust.kinds.categories import Categories, Levels
from gpadjust.kinds.links import Link
from gpadjust.physics import Physics
from gpadjust.validation import Comparison, LeaveOneOut, leave_one_out
from gpadjust.validation.plots import column
from gpadjust.validation.trust import physics_at
from gpadjust.validation.verdict import ALONE


@dataclass(frozen=True)
class Origin:
    """Origin of a page, as far as its subject does not contain it."""

    settings: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  # on the data
    notes: tuple[str, ...] = ()  # on the fit, such as warnings
    how: str = "report(compare(train_X, train_Y, physics))"  # compares a model with others
    physics: str = ""  # Python code of the physics, unless the model's file holds it or its name
    modules: tuple[str, ...] = ()  # that this code needs
    units: Mapping[str, str] = field(default_factory=dict)  # of a log's states, actions and "time"
    program: str = ""  # that identifies the machine of a log in Python, and continues


class Adjusted(NamedTuple):
    """A model of one structure, whose rho, delta and trust are shown for an output."""

    structure: str
    model: GP


@dataclass(frozen=True)
class Subject:
    """The subject of a report: a model, a mixture of several, or a recommended model."""

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
    has_physics: bool  # AR1 has its physics through samples alone
    base: Tensor  # medians of the inputs, d, for slices; of categories a level
    levels: Levels  # names of categories, by column; their numbers are from 0
    batches: list[int]  # columns of batches

    @property
    def link(self) -> Link | None:
        """The link of the models, on whose scale they adjust the physics; None without one."""
        models = getattr(self.model, "models", [self.model])
        link: Link | None = getattr(models[0], "link", None)
        return link

    def outliers(self, output: int) -> list[str]:
        """Return the names of the rows whose observation of an output counts as an outlier."""
        is_out = self.Y[:, output].isfinite() & self.loo.judged[:, output].isnan()
        return [self.rows[i] for i in is_out.nonzero().flatten().tolist()]

    def physics_at(self, X: Tensor, output: int) -> dict[str, Tensor]:
        """Return an output of each physics that is shown, ``n``."""
        shown = self.adjusted[output]
        if shown is None:
            return {}
        return {name: column(f, output) for name, f in physics_at(shown.model, X).items()}


def subject_of(thing: object, rows: Sequence[object] | None = None) -> Subject:
    """Return the subject that a model, a mixture or a comparison is; rows have numbers or names."""
    comparison = None
    model = thing
    if isinstance(thing, Comparison):
        comparison = thing
        model = thing.recommended
    if not isinstance(model, GP | StackedGP):
        raise TypeError(
            "Expected a fitted model of gpadjust, a StackedGP, or a Comparison (which `compare` "
            f"makes); found {type(thing).__name__}. Of many rows report on `gpadjust.compare` of "
            "some hundred."
        )
    if isinstance(model, GP) and not model.is_fitted:
        raise ValueError(
            f"Expected a fitted model; found {model!r}: call `gpadjust.fit(model)` first. To see "
            "whether the physics helps, report on `gpadjust.compare(train_X, train_Y, physics)`."
        )
    data = model.data
    models = getattr(model, "models", [model])  # those of a mixture
    if comparison is not None:
        models = [*comparison.models.values()]
    if rows is None:
        rows = [f"row {i}" for i in range(len(data.X))]
    if len(rows) != len(data.X):
        raise ValueError(f"Expected {len(data.X)} names of rows, one for each, found {len(rows)}.")
    physics = {physics.name: physics for part in models for physics in part.physics}
    base = data.X.quantile(0.5, dim=0)
    levels: Levels = {}
    batches: list[int] = []
    if isinstance(data.transform, Categories):
        batches = data.transform.batches
        for i, values in data.transform.levels.items():
            base[i] = data.X[:, i].median()  # the lower one of two in the middle is a level, too
            if all(isinstance(value, str) for value in values):
                levels[i] = tuple(map(str, values))
    return Subject(
        model,
        comparison,
        data.input_names,
        data.output_names,
        data.X,
        data.Y,
        loo=leave_one_out(model) if comparison is None else comparison.leave_one_out(),
        rows=[*map(str, rows)],
        adjusted=[_adjusted(model, comparison, j) for j in range(len(data.output_names))],
        physics=physics,
        has_physics=bool(physics) or any(isinstance(part, AR1) for part in models),
        base=base,
        levels=levels,
        batches=batches,
    )


def _adjusted(model: GP | StackedGP, comparison: Comparison | None, output: int) -> Adjusted | None:
    """Return the structure of most weight that adjusts a physics, of the models of an output."""
    weights = {(type(model).__name__, model): 1.0}
    if comparison is not None:
        rows = [row for row in [*comparison.table.values()][output] if row.kind != ALONE]
        weights = {(r.structure, comparison.models[r.structure]): r.weight for r in rows}
    elif isinstance(model, StackedGP):
        pairs = zip(model.weights.items(), model.models, strict=True)
        weights = {(name, part): shares[output] for (name, shares), part in pairs}
    for name, part in sorted(weights, key=lambda pair: -weights[pair]):
        if part.physics:
            return Adjusted(name, part)
    return None
