"""Choosing the structure of an adjustment by leave-one-out."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any, Unpack

import torch
from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

from gpadjust.checks import progress_bar
from gpadjust.gp.gaussian import threads_for
from gpadjust.inference.bayes import SamplingWarning
from gpadjust.inference.fitting import check_options, fit
from gpadjust.models import CalibratedPhysics, StackedGP, TermsGP
from gpadjust.models.factory import ModelFactory, make_model, with_options
from gpadjust.models.hyperparameter_samples import take_samples
from gpadjust.models.stacked import check_stackable
from gpadjust.models.term_builder import ModelOptions, PhysicsLike
from gpadjust.models.training_data import ArrayLike, training_data
from gpadjust.physics import PhysicsWarning, as_physics
from gpadjust.validation.advice import Gain, advice
from gpadjust.validation.leave_one_out import LeaveOneOut, leave_one_out, mixed
from gpadjust.validation.ranking import Candidate, beside, ranking
from gpadjust.validation.structures import (
    ALONE,
    STACKED,
    STRUCTURES,
    Structure,
    candidates,
    known_structures,
    physics_alone,
)

_DRAWS = (32, 256)  # of the hyper-parameters, the least and the most
_MEMORY = 20_000  # observations times draws
_HELD = 32  # samples of a model, and components of the stacked one
_MOST_OUTPUTS = 64
_ALL = 0.95  # weight of a structure that needs no others


@dataclass(frozen=True)
class Comparison:
    """Fitted models of several structures, and which of them the data prefer.

    Print it for the tables and the advice.

    Attributes:
        models: The fitted models by the names of their structures.
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

    models: dict[str, TermsGP]
    stacked: StackedGP
    table: dict[str, list[Candidate]]
    advice: list[str]
    gain: dict[str, Gain] = field(default_factory=dict)
    left_out: dict[str, LeaveOneOut] = field(default_factory=dict)
    alone: dict[str, LeaveOneOut] = field(default_factory=dict)

    @property
    def chosen(self) -> str:
        """The structure that has 0.95 of the weight of all outputs, otherwise ``"stacked"``."""
        least = _weights(self.models, self.table).amin(-1).tolist()
        return next((n for n, w in zip(self.models, least, strict=True) if w >= _ALL), STACKED)

    @property
    def recommended(self) -> TermsGP | StackedGP:
        """The fitted model of the structure that has nearly all weight, otherwise the mixture."""
        return self.models.get(self.chosen, self.stacked)

    def leave_one_out(self) -> LeaveOneOut:
        """Predictions of left-out observations by what is recommended, as in the tables.

        Of a mixture its weights stay, which have seen all observations.
        """
        if self.chosen != STACKED:
            return self.left_out[self.chosen]
        weight = _weights(self.models, self.table).unsqueeze(-2)  # K x 1 x m
        return mixed([self.left_out[name] for name in self.models], weight)

    def errors(self) -> dict[str, dict[str, float]]:
        """Root mean square errors of left-out observations of each output, in its units.

        ``"physics alone"``, of several each (of one with unknown parameters ``"calibrated
        physics"``); ``"adjusted"``, what is recommended, or the best structure that adjusts the
        physics if that does not; ``"data alone"``, the best structure without it. What was not
        fitted is not there.
        """
        if not self.left_out:
            return {output: {} for output in self.table}
        recommended = self.leave_one_out().score().rmse
        left_out = {name: loo.score().rmse for name, loo in self.left_out.items()}
        alone = {name: loo.score().rmse for name, loo in self.alone.items()}
        calibrated = {n for n, model in self.models.items() if isinstance(model, CalibratedPhysics)}
        using = {name for name, model in self.models.items() if model.rho_names} - calibrated
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
        """The table of an output, and a row for each physics alone, without weight."""
        if not self.alone:
            return self.table[output]
        beneath = beside(self.alone, self.left_out, [*self.table].index(output))
        return [*self.table[output], *beneath]

    def to_dataframe(self) -> Any:
        """All tables as a pandas DataFrame: a row for each output and candidate, best first.

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
            told = {n: n if n.startswith(ALONE) else f"{n}, left out" for n in errors}
            each = "; ".join(f"{told[name]}: RMSE {rmse:.3g}" for name, rmse in errors.items())
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
    physics: PhysicsLike,
    train_Yvar: ArrayLike = None,
    *,
    structures: Sequence[str | Structure | ModelFactory] | None = None,
    num_starts: int | None = None,
    num_screened: int | None = None,
    seed: int = 0,
    progress: bool = False,
    **options: Unpack[ModelOptions],
) -> Comparison:
    r"""Fit models of several structures and rank them: how should this physics be adjusted?

    ==================  ===========================================================================
    ``"zero mean"``     no physics, :class:`~gpadjust.ZeroMeanGP`
    ``"physics mean"``  :math:`f_p + \delta(x)`, :class:`~gpadjust.PhysicsMeanGP`
    ``"constant rho"``  :math:`\rho f_p + \mu + \delta(x)` with unknown constants
    ``"CKA"``           :math:`\rho(x) (f_p - c) + \delta(x)` with learnt c, :class:`~gpadjust.CKA`
    ==================  ===========================================================================

    All are fitted by full Bayes, once. Each output is judged by itself, by the *expected log
    predictive density* (elpd) of left-out observations, which are out of the hyper-parameters, too,
    by the weights of :func:`leave_one_out`: of few observations it is rather high. A difference of
    less than two standard errors shows nothing.

    What is recommended is the mixture of all, a :class:`~gpadjust.StackedGP` with the weights of
    Yao et al. (2018), or the structure that has nearly all weight
    (:attr:`Comparison.chosen`). ``"CKA"``, whose fit leaves a physics of no use out by itself, has
    the weight of four observations beforehand: the others have to earn theirs by predictions, and
    few observations change little.

    Of several physics each structure is fitted to each of them alone, ``"CKA of coarse"`` and so
    on, and to all at once, ``"CKA of all"``; the advice says which physics the data prefer, and
    where (by the mean size of each rho at the data below and above the median of each input). A
    structure with too many unknown constants for the points is left out of models and tables,
    unless there is no other.

    A physics with unknown parameters is calibrated by each structure that uses it: then
    ``"physics mean"`` is the calibrated physics and a delta (Kennedy and O'Hagan 2001), ``"CKA"``
    that with rho and delta, and ``"calibrated physics"`` is one more structure without either,
    :class:`~gpadjust.CalibratedPhysics`.

    Of a network that learns, left-out observations have had their say in the parameters. The advice
    says so.

    Args:
        train_X: Inputs, ``n x d``, as in :class:`~gpadjust.CKA`.
        train_Y: Targets, ``n x m``.
        physics: The physics f_p, or several, as in :class:`~gpadjust.CKA`. Each model has a copy of
            its own, where it has parameters.
        train_Yvar: Known observation variances, as in :class:`~gpadjust.CKA`.
        structures: Which to fit: names; callables that make a model of X, Y and ``physics``, such
            as ``RRA`` or ``functools.partial(CKA, rho_mean=2.0)``; or a :class:`Structure`, which
            says more of one. Default: those above.
        num_starts: As in :func:`~gpadjust.fit`.
        num_screened: As in :func:`~gpadjust.fit`.
        seed: Seed of the fits.
        progress: Whether to show a progress bar.
        options: What the data are, as in :class:`~gpadjust.CKA`: ``likelihood``,
            ``outcome_transform``, ``input_transform`` and the others that all structures share.
            Each model has a copy of its own; what a structure says itself, it keeps.

    Returns:
        The fitted models, the rankings, the recommended model, and advice in words: whether the
        physics is shown to help, and whether scaling it is better than taking it as the mean.

    Warns:
        PhysicsWarning: As :class:`~gpadjust.CKA`, once for all structures.

    Raises:
        TypeError: As :class:`~gpadjust.CKA` and :func:`~gpadjust.fit`.
        ValueError: As these two; if a structure is unknown or has a name that is taken, or there
            is a batch of data sets.
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
    search: dict[str, Any] = {"num_starts": num_starts, "num_screened": num_screened, "seed": seed}
    check_options("map", search)
    data = training_data(
        train_X,
        train_Y,
        train_Yvar,
        categorical=options.get("categorical"),
        batch=options.get("batch"),
    )
    if data.X.dim() > 2:
        raise ValueError(
            f"Expected one data set, train_X of n x d, got shape {tuple(data.X.shape)}; compare "
            "the data sets of a batch one by one."
        )
    if (m := data.Y.shape[-1]) > _MOST_OUTPUTS:
        raise ValueError(
            f"Expected at most {_MOST_OUTPUTS} outputs, each of which is judged by itself, got "
            f"{m}: compare some of them."
        )
    given_physics = as_physics(physics)
    fitted_to = candidates(asked, given_physics, len(data.X))
    models: dict[str, TermsGP] = {}
    left_out: dict[str, LeaveOneOut] = {}
    converged: dict[str, Tensor] = {}
    relevance: dict[str, Tensor] = {}
    heard: dict[tuple[str, type[Warning]], list[str]] = {}
    number = max(_DRAWS[0], min(_DRAWS[1], _MEMORY // len(data.X)))
    for structure, part in progress_bar(progress, fitted_to, unit="structure"):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PhysicsWarning)
            try:
                model = make_model(
                    with_options(structure.model, options),
                    train_X,
                    train_Y,
                    kind=TermsGP,
                    train_Yvar=train_Yvar,
                    physics=deepcopy(part) if structure.uses_physics else None,
                )
                if models:
                    check_stackable(next(iter(models.values())), model)
                warnings.simplefilter("ignore", OptimizationWarning)
                warnings.simplefilter("ignore", SamplingWarning)  # the advice says so
                with threads_for(len(data.X)):
                    result = fit(model, "bayes", num_samples=number, **search)
                    left_out[structure.name] = leave_one_out(model)
            except Exception as error:
                error.add_note(f"This is of the structure {structure.name!r}.")
                raise
        for each in caught:
            heard.setdefault((str(each.message), each.category), []).append(structure.name)
        converged[structure.name] = result.converged.flatten()
        if result.relevance is not None:
            relevance[structure.name] = result.relevance.flatten()
        models[structure.name] = _thinned(model)
    for (text, category), names in heard.items():
        # One of the physics or of the data is of all models that have them.
        of_all = issubclass(category, PhysicsWarning) or 1 < len(names) == len(models)
        of = "" if of_all else f"{', '.join(names)}: "
        warnings.warn(f"{of}{text}", category, stacklevel=2)
    prior = [structure.prior for structure, _ in fitted_to]
    by_output = [ranking(left_out, j, prior) for j in range(data.Y.shape[-1])]
    table = dict(zip(data.output_names, by_output, strict=True))
    stacked = StackedGP(models, _weights(models, table), _HELD)
    fitted = [structure for structure, _ in fitted_to]
    gain, sentences = advice(fitted, models, left_out, converged, relevance, table, data.X)
    alone = physics_alone(given_physics, data)
    found = Comparison(models, stacked, table, sentences, gain, left_out, alone)
    loo = found.leave_one_out()
    # An error with outliers would not be comparable with the others, which leave them out.
    alone = {name: replace(own, is_outlier=loo.is_outlier) for name, own in alone.items()}
    return replace(found, alone=alone)


def _thinned(model: TermsGP) -> TermsGP:
    """A model that holds some of its samples."""
    if model.num_samples is None or model.num_samples <= _HELD:
        return model
    index = torch.linspace(0, model.num_samples - 1, _HELD).round().long()
    thinned: TermsGP = take_samples(model, index, as_mixture=True)
    return thinned


def _weights(models: dict[str, TermsGP], table: dict[str, list[Candidate]]) -> Tensor:
    """The weights of the tables, ``K x m``, in the order of the models."""
    named = [{row.structure: row.weight for row in rows} for rows in table.values()]
    weights = [[own[name] for own in named] for name in models]
    return torch.tensor(weights, dtype=torch.float64)
