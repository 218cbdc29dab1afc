"""Choosing the structure of an adjustment by leave-one-out."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models.transforms.input import InputTransform
from botorch.posteriors.fully_bayesian import MCMC_DIM
from torch import Tensor
from tqdm import tqdm

from gpadjust.gp.gaussian import threads_for
from gpadjust.inference.bayes import SamplingWarning
from gpadjust.inference.fitting import check_options, fit
from gpadjust.models import StackedGP, TermsGP
from gpadjust.models.hyperparameter_samples import take_samples
from gpadjust.models.parameters import shared_parameters
from gpadjust.models.term_builder import PhysicsLike
from gpadjust.models.training_data import ArrayLike, TrainingData, training_data
from gpadjust.physics import as_physics
from gpadjust.validation.advice import advice, gains
from gpadjust.validation.gain import Gain
from gpadjust.validation.leave_one_out import (
    LeaveOneOut,
    leave_one_out,
    mixture_of,
)
from gpadjust.validation.ranking import Candidate, densities, is_clear, ranking
from gpadjust.validation.refitting import LEAST, refitted
from gpadjust.validation.structures import (
    STACKED,
    STRUCTURES,
    Structure,
    candidates,
    known_structures,
)

_FEW = 24  # observations, up to which each structure is fitted again without each of them
_REFIT = {"num_draws": 512, "num_samples": 64, "num_starts": 4, "num_screened": 64}
_DRAWS = (32, 256)  # of the hyper-parameters, the least and the most
_MEMORY = 20_000  # observations times draws
_HELD = 32  # samples of a model, and components of the stacked one


@dataclass(frozen=True)
class Comparison:
    """Fitted models of several structures, and which of them the data prefer.

    Print it for the tables and the advice.

    Attributes:
        models: The fitted models by the names of their structures.
        stacked: All of them, stacked with the weights of the tables.
        table: The candidates of each output, best first, by the names of the outputs.
        advice: What the comparison says about the physics, in sentences.
        gain: What the physics is worth to each output, by the names of the outputs; empty without a
            structure that uses none.
        left_out: The predictions of left-out observations by each structure, which the tables tell
            of.
    """

    models: dict[str, TermsGP]
    stacked: StackedGP
    table: dict[str, list[Candidate]]
    advice: list[str]
    gain: dict[str, Gain] = field(default_factory=dict)
    left_out: dict[str, LeaveOneOut] = field(default_factory=dict)

    @property
    def chosen(self) -> str:
        """The structure that is clearly best for all outputs, otherwise ``"stacked"``.

        It has nearly all weight, and all others are worse by more than two standard errors, by
        observations of eight different inputs or more.
        """
        numbers = [len(densities(self.left_out, j)) for j in range(len(self.table))]
        names = {rows[0].structure for rows in self.table.values()}
        clear = all(map(is_clear, self.table.values(), numbers))
        return names.pop() if clear and len(names) == 1 else STACKED

    @property
    def recommended(self) -> TermsGP | StackedGP:
        """The fitted model of the structure that is clearly best, otherwise the stacked one."""
        return self.models.get(self.chosen, self.stacked)

    def leave_one_out(self) -> LeaveOneOut:
        """Predictions of left-out observations by what is recommended, as in the tables.

        Of a mixture its weights stay, which have seen all observations.
        """
        if self.chosen != STACKED:
            return self.left_out[self.chosen]
        each = [self.left_out[name] for name in self.models]
        mean, variance, density = (
            torch.stack([getattr(loo, name) for loo in each], MCMC_DIM)
            for name in ("mean", "variance", "log_density")
        )
        weight = _weights(self.models, [*self.table.values()]).unsqueeze(-2)  # K x 1 x m
        mean, variance, density = mixture_of(mean, variance, density, weight)
        return replace(each[0], mean=mean, variance=variance, log_density=density)

    def __str__(self) -> str:
        width = max(len(row.structure) for rows in self.table.values() for row in rows)
        head = ("elpd", "elpd diff", "its error", "weight", "RMSE/sd", "coverage")
        lines: list[str] = []
        for output, rows in self.table.items():
            lines.append(f"{output:{width}}" + "".join(f"  {name:>9}" for name in head))
            lines += [
                f"{row.structure:{width}}  {row.elpd:>9.4g}  {row.elpd_diff:>9.3g}"
                f"  {row.se_diff:>9.2g}  {row.weight:>9.2f}  {row.rmse:>9.3g}  {row.coverage:>9.2f}"
                for row in rows
            ]
            lines.append("")
        return "\n".join([*lines, *self.advice])


def compare(
    train_X: ArrayLike,
    train_Y: ArrayLike,
    physics: PhysicsLike,
    train_Yvar: ArrayLike = None,
    *,
    input_transform: InputTransform | None = None,
    structures: Sequence[str | Structure] = STRUCTURES,
    num_starts: int | None = None,
    num_screened: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Comparison:
    r"""Fit models of several structures and rank them: how should this physics be adjusted?

    ==================  ===========================================================================
    ``"zero mean"``     no physics, :class:`~gpadjust.ZeroMeanGP`
    ``"physics mean"``  :math:`f_p + \delta(x)`, :class:`~gpadjust.PhysicsMeanGP`
    ``"constant rho"``  :math:`\rho f_p + \mu + \delta(x)` with unknown constants
    ``"CKA"``           :math:`\rho(x) (f_p - c) + \delta(x)` with learnt c, :class:`~gpadjust.CKA`
    ==================  ===========================================================================

    All are fitted by full Bayes. Each output is judged by itself, by the *expected log predictive
    density* (elpd) of left-out observations, of which each is out of the hyper-parameters, too: up
    to 24 observations, by fitting again without each of them, and with more by the weights of
    :func:`leave_one_out`. A difference of less than two standard errors shows nothing. Where no
    structure is clearly best (:attr:`Comparison.chosen`), the recommended model is their mixture, a
    :class:`~gpadjust.StackedGP` with the weights of :func:`stacking_weights`. Fitting again takes
    its time: some 30 seconds of 24 observations of three outputs, on one core.

    Of several physics each structure is fitted to each of them alone, ``"CKA of coarse"`` and so
    on, and to all at once, ``"CKA of all"``; the advice says which physics the data prefer, and
    where (by the mean size of each rho at the data below and above the median of each input). A
    structure with too many unknown constants for the points is left out of models and tables,
    unless there is no other.

    A physics with unknown parameters is calibrated by each structure that uses it: then
    ``"physics mean"`` is the calibrated physics and a delta (Kennedy and O'Hagan 2001), ``"CKA"``
    that with rho and delta, and ``"calibrated physics"`` is one more structure without either,
    :class:`~gpadjust.CalibratedPhysics`. Left-out observations are then predicted by weights,
    however few there are.

    The parameters of a network that learns are not fitted again, so that left-out observations have
    had their say in them. The advice says so.

    Args:
        train_X: Inputs, ``n x d``, as in :class:`~gpadjust.CKA`.
        train_Y: Targets, ``n x m``.
        physics: The physics f_p, or several, as in :class:`~gpadjust.CKA`. Each model has a copy of
            its own, where it has parameters.
        train_Yvar: Known observation variances, as in :class:`~gpadjust.CKA`.
        input_transform: As in :class:`~gpadjust.CKA`; each model has a copy of its own.
        structures: Which to fit: names, or a :class:`Structure` of your own.
        num_starts: As in :func:`~gpadjust.fit`.
        num_screened: As in :func:`~gpadjust.fit`.
        seed: Seed of the fits.
        progress: Whether to show a progress bar.

    Returns:
        The fitted models, the rankings, the recommended model, and advice in words: whether the
        physics is shown to help, and whether scaling it is better than taking it as the mean.

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
    asked = known_structures(structures)
    search: dict[str, Any] = {"num_starts": num_starts, "num_screened": num_screened, "seed": seed}
    check_options("map", search)
    given = {name: value for name, value in search.items() if value is not None}
    data = training_data(train_X, train_Y, train_Yvar)
    if data.X.dim() > 2:
        raise ValueError(
            f"Expected one data set, train_X of n x d, got shape {tuple(data.X.shape)}; compare "
            "the data sets of a batch one by one."
        )
    found = candidates(asked, as_physics(physics), len(data.X))
    models: dict[str, TermsGP] = {}
    left_out: dict[str, LeaveOneOut] = {}
    converged: dict[str, Tensor] = {}
    for structure, part in tqdm(found, disable=not progress, unit="structure"):
        try:
            model = structure.build(
                train_X,
                train_Y,
                train_Yvar,
                physics=deepcopy(part),
                input_transform=deepcopy(input_transform),
            )
            with (
                warnings.catch_warnings(record=True) as caught,
                threads_for(len(data.X)),
            ):
                warnings.simplefilter("ignore", OptimizationWarning)
                warnings.simplefilter("ignore", SamplingWarning)  # the advice says so
                result = fit(model, "bayes", num_samples=_number(len(data.X)), **search)
                apart = not shared_parameters(model) and not model.has_unknowns
                again = apart and _can_be_left_out(data)
                left_out[structure.name] = (
                    refitted(structure, data, part, input_transform, **{**_REFIT, **given})
                    if again
                    else leave_one_out(model)
                )
        except Exception as error:
            error.add_note(f"This is of the structure {structure.name!r}.")
            raise
        for each in caught:
            warnings.warn(f"{structure.name}: {each.message}", each.category, stacklevel=2)
        converged[structure.name] = result.converged.flatten()
        models[structure.name] = _thinned(model, _HELD)
    by_output = [ranking(left_out, j) for j in range(data.Y.shape[-1])]
    table = dict(zip(data.output_names, by_output, strict=True))
    stacked = StackedGP(models, _weights(models, by_output), _HELD)
    fitted = [structure for structure, _ in found]
    sentences = advice(fitted, models, left_out, converged, table, data.X)
    gain = gains(fitted, left_out, table)
    return Comparison(models, stacked, table, sentences, gain, left_out)


def _number(num_points: int) -> int:
    """How many samples of the hyper-parameters leave-one-out is told by."""
    least, most = _DRAWS
    return max(least, min(most, _MEMORY // num_points))


def _can_be_left_out(data: TrainingData) -> bool:
    """Whether each structure can be fitted again without each observation."""
    observed = (~data.Y.isnan()).sum(-2)
    return len(data.X) <= _FEW and int(observed.min()) >= LEAST


def _thinned(model: TermsGP, number: int) -> TermsGP:
    """A model that holds some of its samples."""
    if model.num_samples is None or model.num_samples <= number:
        return model
    index = torch.linspace(0, model.num_samples - 1, number).round().long()
    thinned: TermsGP = take_samples(model, index, as_mixture=True)
    return thinned


def _weights(models: dict[str, TermsGP], by_output: list[list[Candidate]]) -> Tensor:
    """The weights of the tables, ``K x m``, in the order of the models."""
    named = [{row.structure: row.weight for row in rows} for rows in by_output]
    weights = [[own[name] for own in named] for name in models]
    return torch.tensor(weights, dtype=torch.float64)
