"""How should a physics be adjusted? Structures, fitted and compared by left-out observations."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from torch import Tensor

from gpadjust.checks import check_choice
from gpadjust.core import (
    CKA,
    GP,
    CalibratedPhysics,
    FitResult,
    PhysicsMeanGP,
    SamplingWarning,
    StackedGP,
    ZeroMeanGP,
    fit,
)
from gpadjust.core.data import ArrayLike
from gpadjust.display import Display, html_table
from gpadjust.kinds.factory import ModelFactory, make_model, with_options
from gpadjust.physics import Physics, PhysicsWarning, as_physics
from gpadjust.progress import progress_bar
from gpadjust.validation.faults import fault_of
from gpadjust.validation.leave_one_out import LeaveOneOut, leave_one_out, left_out_by_physics
from gpadjust.validation.verdict import (
    ADJUSTED,
    ALONE,
    CALIBRATED,
    COUNTS,
    DATA,
    Candidate,
    Verdict,
    difference,
    formulas_of,
    name_of,
    unsampled,
    verdict_of,
)
from gpadjust.words import about, name_among, number, percent

STACKED = "stacked"  # the name of the mixture of all structures in a comparison
_ALL = 0.95  # weight of a structure that needs no others
_KINDS = (ALONE, CALIBRATED, ADJUSTED, DATA)


class Structure(NamedTuple):
    """A way to adjust a physics, one of those that :func:`~gpadjust.compare` fits.

    Attributes:
        name: Its name.
        model: A callable that makes the model of ``X`` and ``Y``, of any number of outputs, each by
            itself: a class, or ``functools.partial`` of one. Its keywords are the ``physics``, if
            it uses that, ``train_Yvar``, if there is one, and the options of
            :func:`~gpadjust.compare`.
        kind: ``"adjusted"``; ``"data alone"`` if it does not use the physics; or
            ``"calibrated physics"`` if it is of a single physics with unknown parameters only.
    """

    name: str
    model: ModelFactory
    kind: str = ADJUSTED


STRUCTURES = (
    Structure(CALIBRATED, CalibratedPhysics, kind=CALIBRATED),
    Structure("zero mean", ZeroMeanGP, kind=DATA),
    Structure("physics mean", PhysicsMeanGP),
    Structure("CKA", CKA),
)
"""The structures that :func:`gpadjust.compare` knows; add your own to them."""


@dataclass(frozen=True)
class Comparison(Display):
    """Fitted models of several structures, ranked by the data. Print it for the tables.

    Attributes:
        models: The fitted models by the names of their structures.
        results: The results of the fits by these names.
        stacked: All models, stacked with the weights of the tables.
        left_out: The predictions of left-out observations by each structure, and by the physics as
            it is, ``"physics alone"`` (of several ``"physics alone of coarse"`` and so on).
        table: The candidates of each output, best first, by the names of the outputs; beneath them
            each physics alone, which has no weight (NaN).
        verdict: The verdict on the physics, by the names of the outputs; empty unless structures
            with and without it are compared.
        advice: Further findings, in sentences.
    """

    models: dict[str, GP]
    results: dict[str, FitResult]
    stacked: StackedGP
    left_out: dict[str, LeaveOneOut]
    table: dict[str, list[Candidate]]
    verdict: dict[str, Verdict]
    advice: list[str]

    @property
    def chosen(self) -> str:
        """The structure that has 0.95 of the weight of all outputs, otherwise ``"stacked"``."""
        return _chosen(self.stacked)

    @property
    def recommended(self) -> GP | StackedGP:
        """The fitted model of the structure that has nearly all weight, otherwise the mixture."""
        return self.models.get(self.chosen, self.stacked)

    def leave_one_out(self) -> LeaveOneOut:
        """Return predictions of left-out observations by the recommended model.

        The weights of a mixture stay; they have seen all observations.
        """
        if self.chosen != STACKED:
            return self.left_out[self.chosen]
        return leave_one_out(self.stacked)

    def errors(self) -> dict[str, dict[str, float]]:
        """Return root mean square errors of left-out observations of each output, in its units.

        ``"physics alone"`` and ``"calibrated physics"``, of several physics each; ``"adjusted"``,
        the recommended model, or the best structure that adjusts the physics if that does not;
        ``"data alone"``, the best structure without it. What was not fitted is not there.
        """
        kinds = {row.structure: row.kind for rows in self.table.values() for row in rows}
        recommends_adjusting = kinds.get(self.chosen, ADJUSTED) == ADJUSTED
        recommended = self.leave_one_out().score().rmse.tolist()
        errors: dict[str, dict[str, float]] = {}
        for (output, rows), rmse in zip(self.table.items(), recommended, strict=True):
            errors[output] = {}
            for row in sorted(rows, key=lambda row: _KINDS.index(row.kind)):
                is_physics = row.kind in (ALONE, CALIBRATED)
                name = row.structure if is_physics else row.kind
                errors[output].setdefault(name, row.error)  # the best of a kind is the first
            if ADJUSTED in errors[output] and recommends_adjusting:
                errors[output][ADJUSTED] = rmse
        return errors

    def to_dataframe(self) -> Any:
        """Return all tables as a pandas DataFrame: a row for each output and candidate, best first.

        Its columns are ``output`` and those of :class:`Candidate`. An ImportError without pandas.
        """
        try:
            from pandas import DataFrame
        except ImportError as error:
            raise ImportError("to_dataframe() needs pandas; run `pip install pandas`.") from error
        tables = self.table.items()
        return DataFrame(
            [{"output": name, **row._asdict()} for name, rows in tables for row in rows]
        )

    def __str__(self) -> str:
        lines: list[str] = []
        for output, errors in self.errors().items():
            texts = [f"{_left_out(name)}: RMSE {rmse:.3g}" for name, rmse in errors.items()]
            lines.append(about([name_among(output, self.table)], "; ".join(texts)))
        lines.append("")
        width = max(len(row.structure) for rows in self.table.values() for row in rows)
        for output, rows in self.table.items():
            cells = [(output, [*cells_of(rows[0])])]  # the first line has the names of columns
            cells += [(row.structure, [*cells_of(row).values()]) for row in rows]
            for name, texts in cells:
                lines.append(f"{name:{width}}" + "".join(f"  {text:>9}" for text in texts))
            lines.append("")
        for output, verdict in self.verdict.items():
            sentences = " ".join([f"{verdict.answer}.", *verdict.reasons])
            lines.append(about([name_among(output, self.table)], sentences))
        return "\n".join([*lines, *self.advice])

    def _repr_html_(self) -> str:
        head = ["structure", "RMSE", "in 95 %", "elpd diff", "its error", "weight"]
        tables = []
        answers = {name: f": {verdict.answer}" for name, verdict in self.verdict.items()}
        for output, candidates in self.table.items():
            rows = []
            for row in candidates:
                errors = [number(row.error), percent(row.coverage)]
                cells = cells_of(row)
                rows.append([row.structure, *errors, *(cells[name] for name in head[3:])])
            tables.append(html_table(output + answers.get(output, ""), head, rows))
        return "".join(tables)


def _left_out(name: str) -> str:
    """Return the name of an error, and whether it is of left-out observations."""
    if name.startswith(ALONE):  # it has the same error, left out or not
        return name
    return f"{name}, left out"


def cells_of(row: Candidate) -> dict[str, str]:
    """Return the numbers of a candidate as texts, by the names of their columns."""
    shares = {"weight": row.weight, "of use": row.of_use}
    texts = {name: "-" if math.isnan(x) else f"{x:.2f}" for name, x in shares.items()}
    return {
        "elpd": f"{row.elpd:.4g}",
        "elpd diff": f"{row.elpd_diff:.3g}",
        "its error": f"{row.se_diff:.2g}",
        "weight": texts["weight"],
        "RMSE/sd": f"{row.rmse:.3g}",
        "coverage": f"{row.coverage:.2f}",
        "of use": texts["of use"],
    }


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
    ``"CKA"``           :math:`\rho(x) (f_p - c) + \delta(x)` with fitted c, :class:`~gpadjust.CKA`
    ==================  ===========================================================================

    Each is fitted once, by full Bayes. Each output is judged by itself, by the *expected log
    predictive density* (elpd) of left-out observations, see :func:`leave_one_out`. A difference of
    less than two standard errors shows nothing. The recommended model is the mixture of all, a
    :class:`~gpadjust.StackedGP` with the weights of Yao et al. (2018), or the structure that has
    nearly all weight (:attr:`Comparison.chosen`).

    Of several physics each structure is fitted to each of them alone, ``"CKA of coarse"`` and so
    on, and to all at once, ``"CKA of all"``. A physics with unknown parameters is calibrated by
    each structure that uses it (Kennedy and O'Hagan 2001); ``"calibrated physics"`` is one more
    structure without rho and delta, :class:`~gpadjust.CalibratedPhysics`.

    Args:
        train_X: Inputs, ``n x d``, as in :class:`~gpadjust.CKA`.
        train_Y: Targets, ``n x m``.
        physics: The physics f_p, or several, as in :class:`~gpadjust.CKA`.
        train_Yvar: Known observation variances, as in :class:`~gpadjust.CKA`.
        structures: The structures to fit: names; callables that make a model of X, Y and
            ``physics``, such as ``RRA`` or ``functools.partial(CKA, rho_mean=2.0)``; or a
            :class:`Structure`. Default: those above.
        seed: Seed of the fits.
        progress: If True, show a progress bar.
        options: ``noise``, ``link``, ``input_transform`` and other options of models that all
            structures share. A structure keeps its own.

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
    parts = physics_by_name(physics)
    if structures is None:
        structures = STRUCTURES
    candidates = candidates_of(checked_structures(structures), parts)
    models: dict[str, GP] = {}
    results: dict[str, FitResult] = {}

    # Fit each structure.
    warned: dict[str, list[warnings.WarningMessage]] = {}
    for structure, part in progress_bar(progress, candidates, unit="structure"):
        name = structure.name
        factory = with_options(structure.model, options)
        arguments = {"train_Yvar": train_Yvar, "physics": part}
        with warnings.catch_warnings(record=True) as warned[name]:
            warnings.simplefilter("always")
            warnings.simplefilter("ignore", SamplingWarning)  # the advice mentions it
            try:
                models[name] = make_model(factory, train_X, train_Y, kind=GP, **arguments)
                results[name] = fit(models[name], seed=seed)
            except Exception as error:
                error.add_note(f"This is of the structure {name!r}.")
                raise
    data = next(iter(models.values())).data

    # Predict what is left out, by each structure, by their mixture, and by the physics alone.
    left_out = {name: leave_one_out(model) for name, model in models.items()}
    stacked = StackedGP.by_left_out(models)
    # An error with outliers would not be comparable with the others, which leave them out.
    is_outlier = getattr(left_out.get(_chosen(stacked)), "is_outlier", None)
    for name, part in parts.items():
        if not part.unknowns:  # with unknown parameters the physics alone is CalibratedPhysics
            left_out[name_of(ALONE, name)] = left_out_by_physics(part, data, is_outlier)

    # Rank the structures for each output.
    kinds = {structure.name: structure.kind for structure, _ in candidates}
    table = {
        output: _ranked(j, left_out, kinds, models, results, stacked)
        for j, output in enumerate(data.output_names)
    }
    advice = unsampled(table, results)
    comparison = Comparison(models, results, stacked, left_out, table, {}, advice)

    # Judge the physics, and repeat each warning once: of a physics, or of a recommended structure.
    recommended = {row.structure for rows in table.values() for row in rows if row.weight > COUNTS}
    messages: dict[tuple[str, type[Warning]], None] = {}
    for name in (name for name in warned if name in recommended):
        messages |= {(str(warning.message), warning.category): None for warning in warned[name]}
    verdicts: dict[str, Verdict] = {}
    for j, output in enumerate(data.output_names):
        formulas = formulas_of(comparison, [*parts], j)
        faults = {name: fault_of(data, j, f) for name, f in formulas.items()}
        for name, fault in faults.items():
            if fault is not None:
                subjects = [name, name_among(output, data.output_names)]
                messages[about(subjects, fault.text), PhysicsWarning] = None
        verdict = verdict_of(comparison, j, formulas.get(""), faults.get(""))
        if verdict is not None:
            verdicts[output] = verdict
    for text, category in messages:
        warnings.warn(text, category, stacklevel=2)
    return replace(comparison, verdict=verdicts)


def checked_structures(requested: Any) -> list[Structure]:
    """Return the requested structures, each once."""
    defaults = {structure.name: structure for structure in STRUCTURES}
    if isinstance(requested, str | Structure) or callable(requested):
        requested = [requested]
    structures = []
    unknown = []
    for item in requested:
        if isinstance(item, Structure):
            structures.append(item)
        elif callable(item):
            structures.append(_of_factory(item))
        elif item in defaults:
            structures.append(defaults[item])
        else:
            unknown.append(item)
    if unknown or not structures:
        raise ValueError(
            f"Unknown structures {unknown}; expected some of {', '.join(map(repr, defaults))}, or "
            "a Structure of your own, or a callable that makes a model: a class, or "
            "functools.partial of one."
        )
    for structure in structures:
        check_choice("kind", structure.kind, (ADJUSTED, DATA, CALIBRATED))
    named = {structure.name: structure for structure in structures}
    differ = all(named[structure.name] == structure for structure in structures)
    if not differ or {STACKED, ALONE} & named.keys():
        raise ValueError(
            f"Expected structures of different names, none of them {STACKED!r} (their mixture) or "
            f"{ALONE!r}; found {[structure.name for structure in structures]}. Rename yours."
        )
    return list(named.values())


def _of_factory(factory: Any) -> Structure:
    """Return the structure of a callable that makes a model, named by its class and arguments."""
    function = getattr(factory, "func", factory)
    arguments = [f"{name}={v!r}" for name, v in getattr(factory, "keywords", {}).items()]
    name = getattr(function, "__name__", type(function).__name__)
    defaults = [structure for structure in STRUCTURES if structure.model is function]
    (like,) = defaults or [Structure(name, factory)]
    if arguments:
        name = f"{name}({', '.join(arguments)})"
    return like._replace(name=name, model=factory)


def physics_by_name(physics: Any) -> dict[str, Physics]:
    """Return several physics by their names; a single one by an empty name."""
    if isinstance(physics, Mapping):
        return {str(name): as_physics(part) for name, part in physics.items()}
    if not isinstance(physics, list | tuple):
        return {"": as_physics(physics)}
    parts = [as_physics(part) for part in physics]
    names = [part.name for part in parts]
    named: dict[str, Physics] = {}
    for i, (name, part) in enumerate(zip(names, parts, strict=True)):
        is_name = name.isidentifier() and names.count(name) == 1
        named[name if is_name else f"f_{i + 1}"] = part
    return named


def candidates_of(
    structures: Sequence[Structure], parts: Mapping[str, Physics]
) -> list[tuple[Structure, Any]]:
    """Return the structures to fit with their physics: of one, or of each of several and of all."""
    candidates: list[tuple[Structure, Any]] = []
    for structure in structures:
        if structure.kind == DATA:
            candidates.append((structure, None))
            continue
        for name, part in parts.items():
            if part.unknowns or structure.kind == ADJUSTED:
                named = structure._replace(name=name_of(structure.name, name))
                candidates.append((named, part))
        if structure.kind == ADJUSTED and [*parts] != [""]:
            joined = structure._replace(name=name_of(structure.name, "all"))
            candidates.append((joined, {**parts}))
    if not candidates:
        raise ValueError(
            "Expected a physics with unknown parameters for 'calibrated physics'; found none: name "
            "them, unknowns={'mass': Unknown(1.0, factor=1.5)}."
        )
    return candidates


def _chosen(stacked: StackedGP) -> str:
    """Return the structure that has nearly all weight of all outputs, otherwise the mixture."""
    weights = stacked.weights.items()
    return next((name for name, shares in weights if min(shares) >= _ALL), STACKED)


def _ranked(
    j: int,
    left_out: Mapping[str, LeaveOneOut],
    kinds: Mapping[str, str],
    models: Mapping[str, GP],
    results: Mapping[str, FitResult],
    stacked: StackedGP,
) -> list[Candidate]:
    """Return the structures for output j, best first, and beneath them each physics alone."""
    densities = {name: loo.densities_of(j) for name, loo in left_out.items()}
    best = max((densities[name] for name in models), key=lambda density: float(density.sum()))
    rows = []
    for name, loo in left_out.items():
        scores = loo.score()
        error = float(scores.rmse[j])
        row = Candidate(
            name,
            float(densities[name].sum()),
            *difference(densities[name], best),
            weight=math.nan,
            rmse=error / spread_of(loo.Y[:, j]),
            coverage=float(scores.coverage[j]),
            error=error,
            log_evidence=math.nan,
            of_use=math.nan,
            kind=kinds.get(name, ALONE),
        )
        if name in models:  # of a physics alone there are no weight and no evidence
            model = models[name]
            result = results[name]
            weights = stacked.weights.get(name, [0.0] * model.num_outputs)
            row = row._replace(weight=weights[j])
            if result.log_evidence is not None:
                evidence = result.log_evidence.expand(model.num_outputs)
                row = row._replace(log_evidence=float(evidence[j]))
            if relevance := relevance_of(model, result):
                row = row._replace(of_use=relevance[j])
        rows.append(row)
    return sorted(rows, key=lambda row: (row.structure not in models, -row.elpd))


def relevance_of(model: GP, result: FitResult) -> list[float]:
    """Return the probability that the physics is of use, of each output; empty if unknown."""
    without = [c.text for c in model.table.choices if any(z.endswith(".mean") for z in c.zeros)]
    shares = [result.probabilities[text] for text in without if text in result.probabilities]
    return [1 - sum(of_output) for of_output in zip(*shares, strict=True)]


def spread_of(y: Tensor) -> float:
    """Return the standard deviation of observations, NaN left out; 1 if all are equal."""
    return float(y[~y.isnan()].std()) or 1.0
