"""How should a physics be adjusted? Structures, fitted and compared by left-out observations."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Normal, StudentT

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
from gpadjust.core.data import ArrayLike, Data
from gpadjust.display import Display, html_table
from gpadjust.kinds.factory import ModelFactory, make_model, with_options
from gpadjust.physics import Physics, PhysicsWarning, as_physics
from gpadjust.progress import progress_bar
from gpadjust.validation.faults import fault_of
from gpadjust.validation.leave_one_out import ROUNDING, LeaveOneOut, leave_one_out
from gpadjust.validation.trust import physics_at
from gpadjust.validation.verdict import (
    ADJUSTED,
    ALONE,
    CALIBRATED,
    COUNTS,
    DATA,
    Candidate,
    Evidence,
    Verdict,
    correction_of,
    difference,
    is_shown,
    next_point,
    straight_line,
    unsampled,
    verdict_on,
)
from gpadjust.words import number, percent

STACKED = "stacked"  # what a comparison calls the mixture of all structures
_ALL = 0.95  # weight of a structure that needs no others
_WORST = -1e6  # nats; a density of zero would make others' differences infinite


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
    """Fitted models of several structures, and which of them the data prefer.

    Print it for the tables and the advice.

    Attributes:
        models: The fitted models by the names of their structures.
        results: The results of the fits, such as the probabilities of nested models, by these
            names.
        stacked: All models, stacked with the weights of the tables.
        left_out: The predictions of left-out observations by each structure, and by the physics as
            it is, ``"physics alone"`` (of several ``"physics alone of coarse"`` and so on).
        table: The candidates of each output, best first, by the names of the outputs; beneath them
            each physics alone, which has no weight (NaN).
        verdict: The verdict on the physics, by the names of the outputs; empty if no structure is
            without it, or none with it.
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
        """Return predictions of left-out observations by what is recommended.

        The weights of a mixture stay; they have seen all observations.
        """
        if self.chosen != STACKED:
            return self.left_out[self.chosen]
        return leave_one_out(self.stacked)

    def errors(self) -> dict[str, dict[str, float]]:
        """Return root mean square errors of left-out observations of each output, in its units.

        ``"physics alone"`` (of one with unknown parameters ``"calibrated physics"``), of several
        each; ``"adjusted"``, what is recommended, or the best structure that adjusts the physics if
        that does not; ``"data alone"``, the best structure without it. What was not fitted is not
        there.
        """
        kinds = {row.structure: row.kind for rows in self.table.values() for row in rows}
        recommends_adjusting = kinds.get(self.chosen, ADJUSTED) == ADJUSTED
        recommended = self.leave_one_out().score().rmse.tolist()
        errors: dict[str, dict[str, float]] = {}
        for (output, rows), of_recommended in zip(self.table.items(), recommended, strict=True):
            errors[output] = {}
            for kind in (ALONE, CALIBRATED, ADJUSTED, DATA):
                of_kind = {row.structure: row.error for row in rows if row.kind == kind}
                if kind in (ALONE, CALIBRATED):
                    errors[output] |= of_kind
                elif of_kind:  # the best is the first
                    errors[output][kind] = next(iter(of_kind.values()))
            if ADJUSTED in errors[output] and recommends_adjusting:
                errors[output][ADJUSTED] = of_recommended
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
            where = f"{output}: " if len(self.table) > 1 else ""
            # The error of the physics alone is the same, left out or not.
            called = {n: n if n.startswith(ALONE) else f"{n}, left out" for n in errors}
            each = "; ".join(f"{called[name]}: RMSE {rmse:.3g}" for name, rmse in errors.items())
            lines += [where + each] if each else []
        lines += [""] if lines else []
        width = max(len(row.structure) for rows in self.table.values() for row in rows)
        head = ("elpd", "elpd diff", "its error", "weight", "RMSE/sd", "coverage", "of use")
        for output, rows in self.table.items():
            lines.append(f"{output:{width}}" + "".join(f"  {name:>9}" for name in head))
            for row in rows:
                weight, use = (
                    "-" if math.isnan(x) else f"{x:.2f}" for x in (row.weight, row.of_use)
                )
                lines.append(
                    f"{row.structure:{width}}  {row.elpd:>9.4g}  {row.elpd_diff:>9.3g}"
                    f"  {row.se_diff:>9.2g}  {weight:>9}  {row.rmse:>9.3g}  {row.coverage:>9.2f}"
                    f"  {use:>9}"
                )
            lines.append("")
        for output, verdict in self.verdict.items():
            where = f"{output}: " if len(self.table) > 1 else ""
            lines.append(" ".join([f"{where}{verdict.answer}.", *verdict.reasons]))
        return "\n".join([*lines, *self.advice])

    def _repr_html_(self) -> str:
        head = ["structure", "RMSE", "in 95 %", "elpd diff", "its error", "weight"]
        tables = []
        for output, candidates in self.table.items():
            rows = []
            for row in candidates:
                numbers = map(number, (row.elpd_diff, row.se_diff))
                weight = "-" if math.isnan(row.weight) else f"{row.weight:.2f}"
                rows.append(
                    [row.structure, number(row.error), percent(row.coverage), *numbers, weight]
                )
            verdict = f": {self.verdict[output].answer}" if output in self.verdict else ""
            tables.append(html_table(output + verdict, head, rows))
        return "".join(tables)


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
    on, and to all at once, ``"CKA of all"``, whose rhos tell where the data prefer which.

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
        The fitted models, their rankings, and in words whether the physics is shown to help.

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
    parts = _by_name(physics)
    fitted = _candidates(_known(STRUCTURES if structures is None else structures), parts)
    models: dict[str, GP] = {}
    results: dict[str, FitResult] = {}

    # Fit each structure.
    caught: dict[str, list[warnings.WarningMessage]] = {}
    for structure, part in progress_bar(progress, fitted, unit="structure"):
        name, factory = structure.name, with_options(structure.model, options)
        given = {"train_Yvar": train_Yvar, "physics": None if structure.kind == DATA else part}
        with warnings.catch_warnings(record=True) as caught[name]:
            warnings.simplefilter("always")
            warnings.simplefilter("ignore", SamplingWarning)  # the advice mentions it
            try:
                models[name] = make_model(factory, train_X, train_Y, kind=GP, **given)
                results[name] = fit(models[name], seed=seed)
            except Exception as error:
                error.add_note(f"This is of the structure {name!r}.")
                raise
    data = next(iter(models.values())).data

    # Predict what is left out, by each structure, by their mixture, and by the physics alone.
    left_out = {name: leave_one_out(model) for name, model in models.items()}
    stacked = StackedGP.by_left_out(models)
    # An error with outliers would not be comparable with the others, which leave them out.
    chosen = left_out.get(_chosen(stacked))
    is_outlier = None if chosen is None else chosen.is_outlier
    left_out |= _physics_alone(parts, data, is_outlier)

    # Rank the structures for each output.
    kinds = {structure.name: structure.kind for structure, _ in fitted}
    table = {
        output: _ranked(j, _densities(left_out, j), left_out, kinds, models, results, stacked)
        for j, output in enumerate(data.output_names)
    }
    advice = unsampled(table, results)
    comparison = Comparison(models, results, stacked, left_out, table, {}, advice)

    # Judge the physics, and repeat each warning once: of a physics, or of what is recommended.
    messages: dict[tuple[str, type[Warning]], None] = {}
    for name, each in caught.items():
        if any(row.weight > COUNTS for rows in table.values() for row in rows if row[0] == name):
            messages |= {(str(one.message), one.category): None for one in each}
    verdicts: dict[str, Verdict] = {}
    for j, output in enumerate(data.output_names):
        formulas = _formulas(comparison, [*parts], j)
        found = {name: fault_of(data, j, f) for name, f in formulas.items()}
        for name, fault in found.items():
            where = f"{name}: " if name else ""
            where += f"{output}: " if len(data.output_names) > 1 else ""
            messages |= {(where + fault, PhysicsWarning): None} if fault else {}
        verdict = _verdict(comparison, j, formulas.get(""), found.get("", ""))
        if verdict is not None:
            verdicts[output] = verdict
    for text, category in messages:
        warnings.warn(text, category, stacklevel=2)
    return replace(comparison, verdict=verdicts)


def _formulas(comparison: Comparison, names: Sequence[str], j: int) -> dict[str, Tensor]:
    """Return output j of each physics at the data, unknown parameters as they were fitted."""
    values = {}
    for name in names:
        of = f" of {name}" if name else ""
        known = [f"{kind}{of}" for kind in (ALONE, CALIBRATED)]
        loo = next((comparison.left_out[one] for one in known if one in comparison.left_out), None)
        if loo is not None:
            values[name] = loo.mean[:, j]
            continue
        rows = [*comparison.table.values()][j]
        models = [comparison.models[row.structure] for row in rows if row.kind == ADJUSTED]
        for model in (one for one in models if len(one.physics) == 1 and not name):
            (f,) = physics_at(model, model.data.X).values()
            values[name] = f[:, j]
            break
    return values


def _verdict(c: Comparison, j: int, f: Tensor | None, fault: str) -> Verdict | None:
    """Return the verdict on output j, of a single physics with its values f; None if not asked."""
    output, rows = [*c.table.items()][j]
    rows = [row for row in rows if row.structure in c.models]
    best = next((row for row in rows if row.kind != DATA), None)
    without = next((row for row in rows if row.kind == DATA), None)
    if best is None or without is None:
        return None
    densities, errors = _densities(c.left_out, j), c.errors()[output]
    gain, se = difference(densities[best.structure], densities[without.structure])
    of_use = [row.of_use for row in rows if not math.isnan(row.of_use)]
    adjusted = next((row for row in rows if row.kind == ADJUSTED), best)
    alone = line = factor = offset = math.nan
    loo = c.left_out[best.structure]
    correction, is_surpassed = "", False
    if f is not None:
        formula = next((name for name in (ALONE, CALIBRATED) if name in densities), None)
        if formula is not None:
            is_surpassed = is_shown(densities[adjusted.structure], densities[formula])
        y = loo.Y[:, j]
        if loo.is_outlier is not None:
            y = y.masked_fill(loo.is_outlier[:, j], torch.nan)
        seen = ~y.isnan()
        alone = float((y - f)[seen].square().mean().sqrt())
        factor, offset, line = straight_line(y[seen], f[seen])
        correction = correction_of(c.models[adjusted.structure], j, f)
    evidence = Evidence(
        output,
        len(densities[without.structure]),
        max(of_use, default=math.nan) if math.isnan(best.of_use) else best.of_use,
        gain,
        se,
        alone,
        line,
        errors.get(ADJUSTED, best.error),
        errors[DATA],
        factor,
        offset,
        fault,
        is_surpassed,
        _correction_needed(c.models[adjusted.structure], c.results[adjusted.structure], j),
    )
    pair = c.models[adjusted.structure], c.models[without.structure]
    return verdict_on(evidence, correction, next_point(*pair, j))


def _known(asked: Any) -> list[Structure]:
    """Return the structures that are asked for, each once."""
    names = {structure.name: structure for structure in STRUCTURES}
    is_one = isinstance(asked, str | Structure) or callable(asked)
    asked = [asked] if is_one else [*asked]
    asked = [_of_factory(each) if callable(each) else each for each in asked]
    unknown = [s for s in asked if not isinstance(s, Structure) and s not in names]
    if unknown or not asked:
        raise ValueError(
            f"Unknown structures {unknown}; expected some of {', '.join(map(repr, names))}, or a "
            "Structure of your own, or what makes a model: a class, or functools.partial of one."
        )
    structures = [s if isinstance(s, Structure) else names[s] for s in asked]
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
    """Return the structure of what makes a model, named by its class and arguments."""
    function = getattr(factory, "func", factory)
    arguments = [f"{name}={v!r}" for name, v in getattr(factory, "keywords", {}).items()]
    name = getattr(function, "__name__", type(function).__name__)
    known = [structure for structure in STRUCTURES if structure.model is function]
    like = known[0] if known else Structure(name, factory)
    called = f"{name}({', '.join(arguments)})" if arguments else name
    return like._replace(name=called, model=factory)


def _by_name(physics: Any) -> dict[str, Physics]:
    """Return several physics by their names; a single one by an empty name."""
    if isinstance(physics, Mapping):
        return {str(name): as_physics(each) for name, each in physics.items()}
    if not isinstance(physics, list | tuple):
        return {"": as_physics(physics)}
    parts = [as_physics(each) for each in physics]
    names = [part.name for part in parts]
    named: dict[str, Physics] = {}
    for i, (name, part) in enumerate(zip(names, parts, strict=True)):
        is_name = name.isidentifier() and names.count(name) == 1
        named[name if is_name else f"f_{i + 1}"] = part
    return named


def _candidates(
    structures: Sequence[Structure], parts: Mapping[str, Physics]
) -> list[tuple[Structure, Any]]:
    """Return the structures to be fitted: of one physics, or of each of several and of all."""
    candidates: list[tuple[Structure, Any]] = []
    for structure in structures:
        own = parts
        if structure.kind == CALIBRATED:
            own = {name: part for name, part in parts.items() if part.unknowns}
        if structure.kind == DATA or [*parts] == [""]:
            candidates += [(structure, part) for part in [*own.values()][:1]]
            continue
        for name, part in own.items():
            candidates.append((structure._replace(name=f"{structure.name} of {name}"), part))
        if structure.kind == ADJUSTED:
            joined = structure._replace(name=f"{structure.name} of all")
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
    return next((name for name, each in weights if min(each) >= _ALL), STACKED)


@torch.no_grad()
def _physics_alone(
    parts: Mapping[str, Physics], data: Data, is_outlier: Tensor | None = None
) -> dict[str, LeaveOneOut]:
    r"""Return left-out predictions by each physics as it is, with noise of an unknown variance.

    Nothing is fitted, :math:`y_i = f_p(x_i) + s_i \epsilon_i`, with :math:`s_i = 1` or
    :math:`|f_p(x_i)|`, whichever predicts an output better. With a prior of the variance that does
    not depend on units, an observation that is left out has Student's distribution about f_p with
    the mean square error at the others and ``n - 1`` degrees of freedom (Gelman et al. 2013,
    section 3.2); with known variances it is Gaussian. Physics with unknown parameters are left out:
    alone, they are :class:`~gpadjust.CalibratedPhysics`.
    """
    X, Y = data.X, data.Y
    least = ROUNDING**2 * (Y - Y.nanmean(0)).square().nanmean(0)
    alone = {}
    for name, physics in parts.items():
        if physics.unknowns:
            continue
        mean = physics(X)
        if data.Yvar is not None:
            variance = data.Yvar.maximum(least)
            density = Normal(mean, variance.sqrt(), False).log_prob(Y)
        else:
            variance, density = _with_noise(Y, mean, torch.ones_like(mean), least)
            sizes = mean.abs()
            relative = _with_noise(Y, mean, sizes, least / sizes.square())
            is_relative = relative[1].nansum(0) > density.nansum(0)  # not if f_p is 0 somewhere
            variance = torch.where(is_relative, relative[0], variance)
            density = torch.where(is_relative, relative[1], density)
        pit = torch.special.ndtr((Y - mean) / variance.sqrt())
        alone[f"{ALONE} of {name}" if name else ALONE] = LeaveOneOut(
            X, Y, mean, variance, density, pit, data.output_names, is_outlier
        )
    return alone


def _with_noise(Y: Tensor, mean: Tensor, sizes: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
    """Return variances and log densities, ``n x m``, of noise in proportion to sizes ``n x m``."""
    # (y - f) / s has Student's distribution, and y the density of that over s.
    squares = ((Y - mean) / sizes).square()
    freedom = (~Y.isnan()).sum(0) - 1
    others = squares.nansum(0) - squares.nan_to_num(nan=0.0)
    scale = sizes * (others.clamp_min(0) / freedom).maximum(least).sqrt()
    student = StudentT(freedom.to(mean), mean, scale, validate_args=False)
    return student.variance.nan_to_num(nan=torch.inf), student.log_prob(Y)


def _densities(left_out: Mapping[str, LeaveOneOut], output: int) -> dict[str, Tensor]:
    """Return the log densities ``n`` of an output's observations by each structure.

    Observations of the same inputs are taken together, ``n`` are different inputs: repeated ones
    are no further evidence of where a structure is right, but would seem to be.
    """
    densities = {}
    for name, loo in left_out.items():
        is_observed = ~loo.Y[:, output].isnan()
        density = loo.log_density[is_observed, output]
        density = density.nan_to_num(nan=_WORST, neginf=_WORST).clamp_min(_WORST)
        distinct, group = loo.X[is_observed].unique(dim=0, return_inverse=True)
        if len(distinct) < len(density):
            density = density.new_zeros(len(distinct)).index_add(0, group, density)
        densities[name] = density
    return densities


def _ranked(
    j: int,
    densities: Mapping[str, Tensor],
    left_out: Mapping[str, LeaveOneOut],
    kinds: Mapping[str, str],
    models: Mapping[str, GP],
    results: Mapping[str, FitResult],
    stacked: StackedGP,
) -> list[Candidate]:
    """Return the structures for output j, best first, and beneath them each physics alone."""
    best = max((densities[name] for name in models), key=lambda density: float(density.sum()))
    rows = []
    for name, loo in left_out.items():
        density, scores = densities[name], loo.score()
        error = float(scores.rmse[j])
        weight = log_evidence = of_use = math.nan
        if name in models:
            model, result = models[name], results[name]
            weight = stacked.weights[name][j] if name in stacked.weights else 0.0
            if result.log_evidence is not None:
                log_evidence = float(result.log_evidence.expand(model.num_outputs)[j])
            if relevance := relevance_of(model, result):
                of_use = relevance[j]
        rows.append(
            Candidate(
                name,
                float(density.sum()),
                *difference(density, best),
                weight,
                error / spread_of(loo.Y[:, j]),
                float(scores.coverage[j]),
                error,
                log_evidence,
                of_use,
                kinds.get(name, ALONE),
            )
        )
    return sorted(rows, key=lambda row: (row.structure not in models, -row.elpd))


def relevance_of(model: GP, result: FitResult) -> list[float]:
    """Return the probability that the physics is of use, of each output; empty if not asked."""
    without = [c.text for c in model.table.choices if any(z.endswith(".mean") for z in c.zeros)]
    shares = [result.probabilities[text] for text in without if text in result.probabilities]
    return [1 - sum(each) for each in zip(*shares, strict=True)]


def _correction_needed(model: GP, result: FitResult, j: int) -> float:
    """Return the probability that f_p of output j needs a correction; NaN if unknown."""
    shares = [result.probabilities.get(c.text) for c in model.table.choices if not c.zeros]
    return shares[0][j] if shares and shares[0] else math.nan


def spread_of(y: Tensor) -> float:
    """Return the standard deviation of observations, NaN left out; 1 if all are equal."""
    return float(y[~y.isnan()].std()) or 1.0
