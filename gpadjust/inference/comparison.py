"""Choosing the structure of an adjustment by evidence and leave-one-out."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models.transforms.input import InputTransform
from torch import Tensor
from tqdm import tqdm

from gpadjust.inference.maximisation import FitResult, maximise
from gpadjust.inference.objective import Objective
from gpadjust.models import CKA, RRA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.models.multi_output_gp import MultiOutputGP
from gpadjust.physics import Physics, as_physics
from gpadjust.validation import leave_one_out

Criterion = Literal["leave-one-out", "evidence"]

_STRUCTURES: dict[str, Callable[..., MultiOutputGP]] = {
    "zero mean": lambda *data, physics, **options: ZeroMeanGP(*data, **options),
    "physics mean": PhysicsMeanGP,
    "constant rho": lambda *data, **options: PhysicsMeanGP(
        *data, learn_rho_mean=True, learn_delta_mean=True, **options
    ),
    "CKA": CKA,
    "CKA centred": lambda *data, **options: CKA(*data, center="mean", **options),
    "CKA centred, learnt rho mean": lambda *data, **options: CKA(
        *data, center="mean", learn_rho_mean=True, **options
    ),
    "RRA": RRA,
}
STRUCTURES = tuple(_STRUCTURES)
"""The names of the structures that :func:`compare` knows."""
_UNKNOWNS = {"constant rho": 2, "CKA centred, learnt rho mean": 1}  # constant means
_WITHOUT_PHYSICS = ("zero mean",)
# Without physics these are the zero mean; the others have a kernel or a constant of their own.
_COMPARABLE = ("physics mean", "CKA", "CKA centred", "CKA centred, learnt rho mean")
_WITHOUT_ADJUSTMENT = ("zero mean", "physics mean")
_ENOUGH = 3  # observations for each hyper-parameter; with fewer, point fits are found too sure
_SURE = 2.0  # standard errors that a difference takes to be real


class Candidate(NamedTuple):
    """How well a structure does; sums over outputs and points, in the user's units.

    Attributes:
        structure: Its name.
        evidence: Log marginal likelihood at its best hyper-parameters, with unknown constants at
            their least squares estimates (which flatters them a little); higher is better.
        log_predictive: Sum of the leave-one-out log predictive densities; higher is better.
        rmse: Leave-one-out root mean square error, relative to the standard deviation of the
            targets (mean over outputs).
        coverage: Share of the observations within their 95 % leave-one-out intervals.
        num_parameters: Number of hyper-parameters.
        converged: Whether the optimiser converged.
    """

    structure: str
    evidence: float
    log_predictive: float
    rmse: float
    coverage: float
    num_parameters: int
    converged: bool


@dataclass(frozen=True)
class Comparison:
    """Fitted models of several structures, and which of them the data prefer.

    Print it for the table and the advice.

    Attributes:
        models: The fitted models by the names of their structures.
        table: The candidates, best first.
        criterion: What they are ranked by.
        advice: What the comparison says about the physics, in sentences.
    """

    models: dict[str, MultiOutputGP]
    table: list[Candidate]
    criterion: Criterion
    advice: list[str]

    @property
    def chosen(self) -> str:
        """The name of the best structure.

        RRA is CKA seen through random features, so it is not chosen where CKA is at hand.
        """
        return _best([row.structure for row in self.table])

    @property
    def best(self) -> MultiOutputGP:
        """The fitted model of the best structure."""
        return self.models[self.chosen]

    def __str__(self) -> str:
        width = max(len(row.structure) for row in self.table)
        head = ("structure", "evidence", "LOO density", "LOO RMSE/sd", "coverage", "parameters")
        lines = [f"{head[0]:{width}}" + "".join(f"  {name:>11}" for name in head[1:])]
        lines += [
            f"{row.structure:{width}}  {row.evidence:>11.4g}  {row.log_predictive:>11.4g}"
            f"  {row.rmse:>11.3g}  {row.coverage:>11.2f}  {row.num_parameters:>11}"
            + ("" if row.converged else "  not converged")
            for row in self.table
        ]
        return "\n".join([*lines, "", *self.advice])


def compare(
    train_X: Tensor,
    train_Y: Tensor,
    physics: Physics | Callable[[Tensor], Tensor],
    train_Yvar: Tensor | None = None,
    *,
    input_transform: InputTransform | None = None,
    structures: Sequence[str] = STRUCTURES,
    criterion: Criterion = "leave-one-out",
    num_starts: int | None = None,
    num_screened: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Comparison:
    r"""Fit models of several structures and rank them: how should this physics be adjusted?

    ==================================  ===========================================================
    ``"zero mean"``                     no physics, :class:`~gpadjust.ZeroMeanGP`
    ``"physics mean"``                  :math:`f_p + \delta(x)`, :class:`~gpadjust.PhysicsMeanGP`
    ``"constant rho"``                  :math:`\rho f_p + \mu + \delta(x)` with unknown constants
    ``"CKA"``                           :math:`\rho(x) f_p + \delta(x)`, :class:`~gpadjust.CKA`
    ``"CKA centred"``                   with the kernel on f_p less its mean
    ``"CKA centred, learnt rho mean"``  and an unknown constant mean of :math:`\rho`
    ``"RRA"``                           on random features, :class:`~gpadjust.RRA`
    ==================================  ===========================================================

    Two numbers tell how good a structure is: its *evidence*, the marginal likelihood at the best
    hyper-parameters, and the *leave-one-out* log predictive density, which judges predictions and
    minds neither the number of hyper-parameters nor how vague their priors are. Where they
    disagree by little, take the simpler structure. RRA is ranked with the others, but CKA, which it
    approximates, is chosen in its place.

    Args:
        train_X: Inputs, ``n x d``, float64.
        train_Y: Targets, ``n x m``, float64; one structure is chosen for all outputs.
        physics: The physics f_p, as in :class:`~gpadjust.CKA`.
        train_Yvar: Known observation variances, ``n x m``, or None to learn the noise.
        input_transform: As in :class:`~gpadjust.CKA`.
        structures: Which to fit.
        criterion: ``"leave-one-out"`` or ``"evidence"``, what to rank them by.
        num_starts: As in :func:`~gpadjust.fit`.
        num_screened: As in :func:`~gpadjust.fit`.
        seed: Seed of the fits.
        progress: Whether to show a progress bar.

    Returns:
        The fitted models, the ranking, and advice in words: whether the physics helps, and whether
        adjusting it is better than taking it as the mean.

    Raises:
        TypeError: As :class:`~gpadjust.CKA`.
        ValueError: As :class:`~gpadjust.CKA`; if a structure or criterion is unknown, or there is
            a batch of data sets.
        PhysicsError: As :class:`~gpadjust.CKA`.

    Example:
        >>> import torch
        >>> from gpadjust import compare
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> comparison = compare(
        ...     X, 2 * torch.sin(6 * X) + X, lambda X: torch.sin(6 * X),
        ...     structures=["zero mean", "physics mean", "CKA"],
        ... )
        >>> comparison.chosen
        'CKA'
        >>> mean, variance = comparison.best.predict(X)
    """
    if isinstance(structures, str):
        structures = [structures]
    structures = list(dict.fromkeys(structures))
    unknown = [name for name in structures if name not in _STRUCTURES]
    if unknown or not structures:
        raise ValueError(
            f"Unknown structures {unknown}; expected some of {', '.join(map(repr, STRUCTURES))}."
        )
    if criterion not in ("leave-one-out", "evidence"):
        raise ValueError(
            f"Unknown criterion {criterion!r}; expected 'leave-one-out' or 'evidence'."
        )
    if isinstance(train_X, Tensor) and train_X.dim() > 2:
        raise ValueError(
            f"Expected one data set, train_X of n x d, got shape {tuple(train_X.shape)}; compare "
            "the data sets of a batch one by one."
        )
    physics = as_physics(physics)
    models: dict[str, MultiOutputGP] = {}
    rows: list[Candidate] = []
    densities: dict[str, Tensor] = {}
    for name in tqdm(structures, disable=not progress, unit="structure"):
        if name in _UNKNOWNS and train_X.shape[-2] < 2 + _UNKNOWNS[name] and len(structures) > 1:
            continue  # too few points for its unknown constants
        model = _STRUCTURES[name](
            train_X, train_Y, train_Yvar, physics=physics, input_transform=input_transform
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", OptimizationWarning)
            result = maximise(Objective(model), num_starts, num_screened, 500, seed)
        models[name] = model
        row, densities[name] = _judge(name, model, result)
        rows.append(row)
    key = "evidence" if criterion == "evidence" else "log_predictive"
    rows.sort(key=lambda row: _or_worst(getattr(row, key)), reverse=True)
    return Comparison(models, rows, criterion, _advice(rows, densities))


def _best(order: list[str]) -> str:
    """The first of an order, but CKA itself rather than its approximation."""
    return next((name for name in order if name != "RRA" or "CKA" not in order), order[0])


def _judge(name: str, model: MultiOutputGP, result: FitResult) -> tuple[Candidate, Tensor]:
    """The row of a fitted model, and the leave-one-out log densities of all observations."""
    loo = leave_one_out(model)
    normal = torch.distributions.Normal(loo.mean, loo.variance.sqrt())
    densities = normal.log_prob(loo.Y).flatten()
    # Likelihoods are in the units of the model's targets, which differ between structures.
    scale: Any = getattr(model, "outcome_transform", None)
    units = 0.0 if scale is None else len(loo.Y) * scale.stdvs.log().sum().item()
    spread = loo.Y.std(-2)
    relative = loo.rmse / spread.where(spread > 0, torch.ones_like(spread))
    learnt = sum(p.numel() for p in model.parameters() if p.requires_grad)
    learnt += len(model.constant_means) * model.num_outputs
    row = Candidate(
        name,
        result.log_likelihood.sum().item() - units,
        densities.sum().item(),
        relative.mean().item(),
        loo.coverage().mean().item(),
        learnt,
        bool(result.converged.all()),
    )
    return row, densities


def _advice(rows: list[Candidate], densities: dict[str, Tensor]) -> list[str]:
    """What the ranking says about the physics."""
    order = [row.structure for row in rows]
    best = next(row for row in rows if row.structure == _best(order))
    sentences = [f"Best: {best.structure}."]
    if len(densities[best.structure]) < _ENOUGH * best.num_parameters:
        sentences.append(
            f"{len(densities[best.structure])} observations are few for {best.num_parameters} "
            "hyper-parameters: the ranking is uncertain, and the intervals of a point fit are too "
            "narrow; see fit(model, 'hmc')."
        )

    def gain(better: str, worse: str) -> tuple[float, float]:
        """Difference of the log predictive densities, and its standard error."""
        difference = densities[better] - densities[worse]
        n = difference.numel()
        return difference.sum().item(), math.sqrt(n) * difference.std(correction=0).item()

    def first(names: Callable[[str], bool]) -> str | None:
        return next((name for name in order if names(name)), None)

    with_physics = first(lambda name: name in _COMPARABLE)
    without = first(lambda name: name in _WITHOUT_PHYSICS)
    if with_physics and without:
        value, error = gain(with_physics, without)
        if value <= _SURE * error:
            sentences.append(
                "As far as these data tell, the physics does not help: left-out observations are "
                f"predicted no better with it ({with_physics}) than without ({value:+.1f} +- "
                f"{error:.1f} nats). Check its units and inputs, or leave it out."
            )
            return sentences
    adjusted = first(lambda name: name not in _WITHOUT_ADJUSTMENT)
    if adjusted and "physics mean" in order:
        value, error = gain(adjusted, "physics mean")
        if value <= _SURE * error:
            sentences.append(
                f"As far as these data tell, scaling the physics ({adjusted}) is no better than "
                f"the physics mean ({value:+.1f} +- {error:.1f} nats): prefer the simpler "
                "PhysicsMeanGP."
            )
    return sentences


def _or_worst(value: float) -> float:
    return value if math.isfinite(value) else -math.inf
