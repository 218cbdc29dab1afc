"""Choosing the structure of an adjustment by leave-one-out."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from gpadjust.checks import progress_bar
from gpadjust.core import GP, CalibratedPhysics, FitResult, SamplingWarning, StackedGP, fit
from gpadjust.core.data import ArrayLike
from gpadjust.kinds.factory import ModelFactory, make_model, with_options
from gpadjust.physics import PhysicsWarning
from gpadjust.validation.advice import Gain, advice
from gpadjust.validation.leave_one_out import LeaveOneOut, leave_one_out
from gpadjust.validation.plausibility import complaint
from gpadjust.validation.ranking import Candidate, best_of, ranking
from gpadjust.validation.structures import (
    ALONE,
    STACKED,
    STRUCTURES,
    Structure,
    by_name,
    candidates,
    known_structures,
    physics_alone,
)

_MOST_OUTPUTS = 64
_ALL = 0.95  # weight of a structure that needs no others


@dataclass(frozen=True)
class Comparison:
    """Fitted models of several structures, and which of them the data prefer.

    Print it for the tables and the advice.

    Attributes:
        models: The fitted models by the names of their structures.
        results: What the fits have found, such as the evidence, by these names.
        stacked: All of them, stacked with the weights of the tables.
        table: The candidates of each output, best first, by the names of the outputs.
        advice: Further findings, in sentences.
        gain: The verdict on the physics, by the names of the outputs; empty if no structure is
            without it.
        left_out: The predictions of left-out observations by each structure, which the tables tell
            of.
        alone: Those by the physics as it is, ``"physics alone"``, of several each: beside the
            candidates (:meth:`rows`), and no part of what is recommended.
    """

    models: dict[str, GP]
    results: dict[str, FitResult]
    stacked: StackedGP
    table: dict[str, list[Candidate]]
    advice: list[str]
    gain: dict[str, Gain]
    left_out: dict[str, LeaveOneOut]
    alone: dict[str, LeaveOneOut] = field(default_factory=dict)

    @property
    def chosen(self) -> str:
        """The structure that has 0.95 of the weight of all outputs, otherwise ``"stacked"``."""
        weights = self.stacked.weights.items()
        return next((name for name, each in weights if min(each) >= _ALL), STACKED)

    @property
    def recommended(self) -> GP | StackedGP:
        """The fitted model of the structure that has nearly all weight, otherwise the mixture."""
        return self.models.get(self.chosen, self.stacked)

    def leave_one_out(self) -> LeaveOneOut:
        """Return predictions of left-out observations by what is recommended.

        Of a mixture its weights stay, which have seen all observations.
        """
        if self.chosen != STACKED:
            return self.left_out[self.chosen]
        return leave_one_out(self.stacked)

    def errors(self) -> dict[str, dict[str, float]]:
        """Return root mean square errors of left-out observations of each output, in its units.

        ``"physics alone"``, of several each (of one with unknown parameters ``"calibrated
        physics"``); ``"adjusted"``, what is recommended, or the best structure that adjusts the
        physics if that does not; ``"data alone"``, the best structure without it. What was not
        fitted is not there.
        """
        recommended = self.leave_one_out().score().rmse
        left_out = {name: loo.score().rmse for name, loo in self.left_out.items()}
        alone = {name: loo.score().rmse for name, loo in self.alone.items()}
        calibrated = {n for n, model in self.models.items() if isinstance(model, CalibratedPhysics)}
        using = {name for name, model in self.models.items() if model.physics} - calibrated
        found: dict[str, dict[str, float]] = {}
        for j, (output, rows) in enumerate(self.table.items()):
            rmse = {row.structure: left_out[row.structure][j].item() for row in rows}
            own = {name: each[j].item() for name, each in alone.items()}
            own |= {name: rmse[name] for name in rmse if name in calibrated}
            if self.chosen in using or (self.chosen == STACKED and using):
                own["adjusted"] = recommended[j].item()
            elif using:
                own["adjusted"] = next(rmse[name] for name in rmse if name in using)
            without = next((name for name in rmse if name not in using | calibrated), None)
            if without is not None:
                own["data alone"] = rmse[without]
            found[output] = own
        return found

    def rows(self, output: str) -> list[Candidate]:
        """Return the table of an output, and a row for each physics alone, without weight."""
        if not self.alone:
            return self.table[output]
        j = [*self.table].index(output)
        return [*self.table[output], *ranking(self.alone, j, {}, best_of(self.left_out, j))]

    def to_dataframe(self) -> Any:
        """Return all tables as a pandas DataFrame: a row for each output and candidate, best first.

        Its columns are ``output`` and those of :class:`Candidate`; rows of a physics alone have no
        weight. An ImportError without pandas.
        """
        try:
            from pandas import DataFrame
        except ImportError as error:
            raise ImportError("to_dataframe() needs pandas; run `pip install pandas`.") from error
        rows = [{"output": name, **r._asdict()} for name in self.table for r in self.rows(name)]
        for row in rows:
            if str(row["structure"]).startswith(ALONE):
                row["weight"] = float("nan")
        return DataFrame(rows)

    def __str__(self) -> str:
        shown = {output: self.rows(output) for output in self.table}
        width = max(len(row.structure) for rows in shown.values() for row in rows)
        head = ("elpd", "elpd diff", "its error", "weight", "RMSE/sd", "coverage")
        lines: list[str] = []
        for output, errors in self.errors().items():
            where = f"{output}: " if len(self.table) > 1 else ""
            # That of the physics alone is the same, left out or not.
            called = {n: n if n.startswith(ALONE) else f"{n}, left out" for n in errors}
            each = "; ".join(f"{called[name]}: RMSE {rmse:.3g}" for name, rmse in errors.items())
            lines += [where + each] if each else []
        lines += [""] if lines else []
        for output, rows in shown.items():
            lines.append(f"{output:{width}}" + "".join(f"  {name:>9}" for name in head))
            for row in rows:
                weight = "-" if row.structure.startswith(ALONE) else f"{row.weight:.2f}"
                lines.append(
                    f"{row.structure:{width}}  {row.elpd:>9.4g}  {row.elpd_diff:>9.3g}"
                    f"  {row.se_diff:>9.2g}  {weight:>9}  {row.rmse:>9.3g}  {row.coverage:>9.2f}"
                )
            lines.append("")
        verdict = [text for name, gain in self.gain.items() for text in gain.sentences(name)]
        return "\n".join([*lines, *verdict, *self.advice])


def compare(
    train_X: ArrayLike,
    train_Y: ArrayLike,
    physics: Any,
    train_Yvar: ArrayLike = None,
    *,
    structures: Sequence[str | Structure | ModelFactory] | None = None,
    seed: int = 0,
    progress: bool = False,
    **options: Any,
) -> Comparison:
    r"""Fit models of several structures and rank them: how should this physics be adjusted?

    ==================  ===========================================================================
    ``"zero mean"``     no physics, :class:`~gpadjust.ZeroMeanGP`
    ``"physics mean"``  :math:`f_p + \delta(x)`, :class:`~gpadjust.PhysicsMeanGP`
    ``"CKA"``           :math:`\rho(x) (f_p - c) + \delta(x)` with learnt c, :class:`~gpadjust.CKA`
    ==================  ===========================================================================

    Each is fitted once, by full Bayes. Each output is judged by itself, by the *expected log
    predictive density* (elpd) of left-out observations, see :func:`leave_one_out`: of few
    observations it is rather high. A difference of less than two standard errors shows nothing.

    What is recommended is the mixture of all, a :class:`~gpadjust.StackedGP` with the weights of
    Yao et al. (2018), or the structure that has nearly all weight (:attr:`Comparison.chosen`).

    Of several physics each structure is fitted to each of them alone, ``"CKA of coarse"`` and so
    on, and to all at once, ``"CKA of all"``; the advice says which physics the data prefer, and
    where (by the mean size of each rho at the data below and above the median of each input).

    A physics with unknown parameters is calibrated by each structure that uses it: then
    ``"physics mean"`` is the calibrated physics and a delta (Kennedy and O'Hagan 2001), ``"CKA"``
    that with rho and delta, and ``"calibrated physics"`` is one more structure without either,
    :class:`~gpadjust.CalibratedPhysics`.

    Args:
        train_X: Inputs, ``n x d``, as in :class:`~gpadjust.CKA`.
        train_Y: Targets, ``n x m``.
        physics: The physics f_p, or several, as in :class:`~gpadjust.CKA`.
        train_Yvar: Known observation variances, as in :class:`~gpadjust.CKA`.
        structures: Which to fit: names; callables that make a model of X, Y and ``physics``, such
            as ``RRA`` or ``functools.partial(CKA, rho_mean=2.0)``; or a :class:`Structure`, which
            specifies more of one. Default: those above.
        seed: Seed of the fits.
        progress: Whether to show a progress bar.
        options: What the data are: ``noise``, ``link``, ``input_transform`` and others that all
            structures share. A structure keeps its own.

    Returns:
        The fitted models, the rankings, the recommended model, and advice in words: whether the
        physics is shown to help, and whether scaling it is better than taking it as the mean.

    Warns:
        PhysicsWarning: If a physics is obviously off.

    Raises:
        TypeError: As :class:`~gpadjust.CKA` and :func:`~gpadjust.fit`.
        ValueError: As these two; if a structure is unknown or has a name that is taken.
        PhysicsError: As :class:`~gpadjust.CKA`.

    Example:
        >>> import torch
        >>> from gpadjust import compare
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> comparison = compare(
        ...     X, 2 * torch.sin(6 * X) + X.exp(), lambda X: torch.sin(6 * X),
        ...     structures=["zero mean", "physics mean", "CKA"],
        ... )
        >>> comparison.chosen
        'CKA'
        >>> mean, variance = comparison.recommended.predict(X)
    """
    asked = known_structures(STRUCTURES if structures is None else structures)
    named = by_name(physics)
    models: dict[str, GP] = {}
    results: dict[str, FitResult] = {}
    fitted = candidates(asked, named)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", SamplingWarning)  # the advice mentions it
        for structure, part in progress_bar(progress, fitted, unit="structure"):
            factory, name = with_options(structure.model, options), structure.name
            own = part if structure.uses_physics else None
            try:
                model = make_model(
                    factory, train_X, train_Y, kind=GP, train_Yvar=train_Yvar, physics=own
                )
                _check_outputs(model)
                results[name] = fit(model, seed=seed)
            except Exception as error:
                error.add_note(f"This is of the structure {name!r}.")
                raise
            models[name] = model
    data = next(iter(models.values())).data
    messages = {(str(each.message), each.category): None for each in caught}
    for name, each in named.items():
        if text := complaint(each, data):
            messages[f"{name}: {text}" if name else text, PhysicsWarning] = None
    for text, category in messages:
        warnings.warn(text, category, stacklevel=2)
    left_out = {name: leave_one_out(model) for name, model in models.items()}
    stacked = StackedGP.by_left_out(models)
    table = _tables(left_out, stacked)
    gain, sentences = advice([each for each, _ in fitted], models, results, left_out, table)
    found = Comparison(models, results, stacked, table, sentences, gain, left_out)
    # An error with outliers would not be comparable with the others, which leave them out.
    is_outlier = found.leave_one_out().is_outlier
    alone = physics_alone(named, data)
    alone = {name: replace(own, is_outlier=is_outlier) for name, own in alone.items()}
    return replace(found, alone=alone)


def _check_outputs(model: GP) -> None:
    if model.num_outputs > _MOST_OUTPUTS:
        raise ValueError(
            f"Expected at most {_MOST_OUTPUTS} outputs, as each is judged by itself; found "
            f"{model.num_outputs}: compare some of them."
        )


def _tables(left_out: Mapping[str, LeaveOneOut], stacked: StackedGP) -> dict[str, list[Candidate]]:
    """Return the ranking of each output."""
    tables = {}
    for j, output in enumerate(stacked.data.output_names):
        weights = {name: each[j] for name, each in stacked.weights.items()}
        tables[output] = ranking(left_out, j, weights, best_of(left_out, j))
    return tables
