"""Choosing the structure of an adjustment by evidence and leave-one-out."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, cast

import torch
from botorch.exceptions.warnings import OptimizationWarning
from botorch.models.transforms.input import InputTransform
from botorch.models.transforms.outcome import nanstd
from torch import Tensor
from tqdm import tqdm

from gpadjust.gp.gaussian import threads_for
from gpadjust.inference.fitting import fit
from gpadjust.inference.map_fit import FitResult
from gpadjust.models import CKA, RRA, ExactGPBase, PhysicsMeanGP, ZeroMeanGP
from gpadjust.models.adjusted_gp import PhysicsLike
from gpadjust.models.training_data import ArrayLike, training_data
from gpadjust.physics import JoinedPhysics, Physics, as_physics
from gpadjust.validation.leave_one_out import leave_one_out

Criterion = Literal["leave-one-out", "evidence"]


class Structure(NamedTuple):
    """A way to adjust a physics, one of those that :func:`compare` fits.

    Attributes:
        name: Its name.
        build: Makes the model of ``train_X, train_Y, train_Yvar`` with the keyword arguments
            ``physics`` and ``input_transform``.
        unknowns: How many constant means are unknown, for one physics.
        uses_physics: Whether it reads the physics at all.
        adjusts: Whether it does more than to take the physics as a mean.
        joins: Whether it takes several physics at once.
    """

    name: str
    build: Callable[..., ExactGPBase]
    unknowns: int = 0
    uses_physics: bool = True
    adjusts: bool = True
    joins: bool = True


def _zero_mean(*data: Any, physics: PhysicsLike, **options: Any) -> ExactGPBase:
    return ZeroMeanGP(*data, **options)


STRUCTURES = (
    Structure("zero mean", _zero_mean, uses_physics=False, adjusts=False, joins=False),
    Structure("physics mean", PhysicsMeanGP, adjusts=False),
    Structure(
        "constant rho", partial(PhysicsMeanGP, rho_mean="learn", delta_mean="learn"), unknowns=2
    ),
    Structure("CKA", CKA),
    Structure("CKA centred", partial(CKA, center="mean")),
    Structure(
        "CKA centred, learnt rho mean", partial(CKA, center="mean", rho_mean="learn"), unknowns=1
    ),
    Structure("RRA", RRA),
)
"""The structures that :func:`compare` knows; add your own to them."""
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

    models: dict[str, ExactGPBase]
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
    def best(self) -> ExactGPBase:
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
    train_X: ArrayLike,
    train_Y: ArrayLike,
    physics: PhysicsLike,
    train_Yvar: ArrayLike = None,
    *,
    input_transform: InputTransform | None = None,
    structures: Sequence[str | Structure] = STRUCTURES,
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

    Of several physics each structure is fitted to each of them alone, ``"CKA of coarse"`` and so
    on, and to all at once, ``"CKA of all"``; the advice says which physics the data prefer, and
    where (by the mean size of each rho in the halves of each input's range).

    Two numbers tell how good a structure is: its *evidence*, the marginal likelihood at the best
    hyper-parameters, and the *leave-one-out* log predictive density, which judges predictions and
    minds neither the number of hyper-parameters nor how vague their priors are. Where they
    disagree by little, take the simpler structure. RRA is ranked with the others, but CKA, which it
    approximates, is chosen in its place.

    Args:
        train_X: Inputs, ``n x d``, as in :class:`~gpadjust.CKA`.
        train_Y: Targets, ``n x m``; one structure is chosen for all outputs.
        physics: The physics f_p, or several, as in :class:`~gpadjust.CKA`. Each model has a copy of
            its own, where it has parameters.
        train_Yvar: Known observation variances, as in :class:`~gpadjust.CKA`.
        input_transform: As in :class:`~gpadjust.CKA`; each model has a copy of its own.
        structures: Which to fit: names, or a :class:`Structure` of your own.
        criterion: ``"leave-one-out"`` or ``"evidence"``, what to rank them by.
        num_starts: As in :func:`~gpadjust.fit`.
        num_screened: As in :func:`~gpadjust.fit`.
        seed: Seed of the fits.
        progress: Whether to show a progress bar.

    Returns:
        The fitted models, the ranking, and advice in words: whether the physics helps, and whether
        adjusting it is better than taking it as the mean.

    Raises:
        TypeError: As :class:`~gpadjust.CKA` and :func:`~gpadjust.fit`.
        ValueError: As these two; if a structure or criterion is unknown, or there is a batch of
            data sets.
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
    chosen = _known(structures)
    if criterion not in ("leave-one-out", "evidence"):
        raise ValueError(
            f"Unknown criterion {criterion!r}; expected 'leave-one-out' or 'evidence'."
        )
    data = training_data(train_X, train_Y, train_Yvar)
    if data.X.dim() > 2:
        raise ValueError(
            f"Expected one data set, train_X of n x d, got shape {tuple(data.X.shape)}; compare "
            "the data sets of a batch one by one."
        )
    candidates = _candidates(chosen, as_physics(physics))
    models: dict[str, ExactGPBase] = {}
    rows: list[Candidate] = []
    densities: dict[str, Tensor] = {}
    for structure, part in tqdm(candidates, disable=not progress, unit="structure"):
        parts = len(part.parts) if isinstance(part, JoinedPhysics) else 1
        unknowns = structure.unknowns + (parts - 1 if parts > 1 else 0)
        if unknowns and len(data.X) < 2 + unknowns and len(candidates) > 1:
            continue  # too few points for its unknown constants
        try:
            model = structure.build(
                train_X,
                train_Y,
                train_Yvar,
                physics=deepcopy(part),
                input_transform=deepcopy(input_transform),
            )
        except Exception as error:
            error.add_note(f"This is of the structure {structure.name!r}.")
            raise
        with warnings.catch_warnings(), threads_for(len(data.X), others=True):
            warnings.simplefilter("ignore", OptimizationWarning)
            result = fit(model, num_starts=num_starts, num_screened=num_screened, seed=seed)
            row, densities[structure.name] = _judge(structure, model, result)
        models[structure.name] = model
        rows.append(row)
    key = "evidence" if criterion == "evidence" else "log_predictive"
    rows.sort(key=lambda row: _or_worst(getattr(row, key)), reverse=True)
    by_name = {structure.name: structure for structure, _ in candidates}
    advice = _advice(rows, densities, by_name)
    best = models[_best([row.structure for row in rows])]
    if isinstance(as_physics(physics), JoinedPhysics):
        advice.extend(_preferred(best, data.X))
    return Comparison(models, rows, criterion, advice)


def _known(structures: Sequence[str | Structure]) -> list[Structure]:
    """The structures that are asked for, each once."""
    names = {structure.name: structure for structure in STRUCTURES}
    given = [structures] if isinstance(structures, str | Structure) else [*structures]
    unknown = [s for s in given if not isinstance(s, Structure) and s not in names]
    if unknown or not given:
        raise ValueError(
            f"Unknown structures {unknown}; expected some of {', '.join(map(repr, names))}, or a "
            "Structure of your own."
        )
    found = [s if isinstance(s, Structure) else names[s] for s in given]
    named = {structure.name: structure for structure in found}
    if any(named[structure.name] != structure for structure in found):
        raise ValueError("Expected structures of different names; give yours a name of its own.")
    return list(named.values())


def _candidates(structures: list[Structure], physics: Physics) -> list[tuple[Structure, Physics]]:
    """What is to be fitted: structures of one physics, or of each of several and of all."""
    if not isinstance(physics, JoinedPhysics):
        return [(structure, physics) for structure in structures]
    candidates: list[tuple[Structure, Physics]] = []
    for structure in structures:
        if not structure.uses_physics:
            candidates.append((structure, physics))
            continue
        parts = cast(Iterable[Physics], physics.parts)
        of: list[tuple[str, Physics]] = [*zip(physics.names, parts, strict=True)]
        of += [("all", physics)] if structure.joins else []
        for name, part in of:
            named = structure._replace(name=f"{structure.name} of {name}")
            candidates.append((named, part))
    return candidates


def _preferred(model: ExactGPBase, X: Tensor) -> list[str]:
    """Which physics a model of several relies on, and where."""
    names = getattr(model, "rho_names", ())
    if len(names) < 2:
        return []
    with torch.no_grad():
        if set(names) <= set(model.term_names):
            sizes = torch.stack([model.term(n, X).mean.abs().mean(-1) for n in names])  # k x n
        else:
            sizes = torch.tensor([abs(model.term_mean(n)) for n in names]).unsqueeze(-1)
            sizes = sizes.expand(-1, len(X)).to(X)
    labels = [name.removeprefix("rho_") for name in names]
    overall = sizes.mean(-1)
    shares = ", ".join(f"{n} {w:.2g}" for n, w in zip(labels, overall.tolist(), strict=True))
    sentences = [f"Mean size of rho at the data: {shares}."]
    for i in range(X.shape[-1]):
        low = X[:, i] <= X[:, i].median()
        if low.all():
            continue
        first, second = sizes[:, low].mean(-1), sizes[:, ~low].mean(-1)
        a, b = int(first.argmax()), int(second.argmax())
        if a != b:
            sentences.append(
                f"Below the median of {model.input_names[i]} the data prefer {labels[a]}, above it "
                f"{labels[b]}."
            )
    return sentences


def _best(order: list[str]) -> str:
    """The first of an order, but CKA itself rather than its approximation."""
    return next(
        (n for n in order if "RRA" not in n or n.replace("RRA", "CKA") not in order), order[0]
    )


def _judge(structure: Structure, model: ExactGPBase, result: FitResult) -> tuple[Candidate, Tensor]:
    """The row of a fitted model, and the leave-one-out log densities of all observations."""
    loo = leave_one_out(model)
    observed = ~loo.Y.isnan()
    normal = torch.distributions.Normal(loo.mean, loo.variance.sqrt(), validate_args=False)
    densities = normal.log_prob(loo.Y)[observed]
    # Likelihoods are in the units of the model's targets, which differ between structures.
    scale: Any = getattr(model, "outcome_transform", None)
    units = 0.0 if scale is None else (observed * scale.stdvs.log()).sum().item()
    spread = nanstd(loo.Y, dim=-2)
    relative = loo.rmse / spread.where(spread > 0, torch.ones_like(spread))
    learnt = sum(p.numel() for p in model.parameters() if p.requires_grad)
    learnt += sum(term.learns_mean for term in model.terms) * model.num_outputs
    row = Candidate(
        structure.name,
        result.log_likelihood.sum().item() - units,
        densities.sum().item(),
        relative.mean().item(),
        loo.coverage().mean().item(),
        learnt,
        bool(result.converged.all()),
    )
    return row, densities


def _advice(
    rows: list[Candidate], densities: dict[str, Tensor], structures: dict[str, Structure]
) -> list[str]:
    """What the ranking says about the physics."""
    order = [row.structure for row in rows]
    best = next(row for row in rows if row.structure == _best(order))
    sentences = [f"Best: {best.structure}."]
    if len(densities[best.structure]) < _ENOUGH * best.num_parameters:
        sentences.append(
            f"{len(densities[best.structure])} observations are few for {best.num_parameters} "
            "hyper-parameters: the ranking is uncertain, and the intervals of a point fit are too "
            "narrow; see fit(model)."
        )

    def gain(better: str, worse: str) -> tuple[float, float]:
        """Difference of the log predictive densities, and its standard error."""
        difference = densities[better] - densities[worse]
        n = difference.numel()
        return difference.sum().item(), math.sqrt(n) * difference.std(correction=0).item()

    def first(names: Callable[[str], bool]) -> str | None:
        return next((name for name in order if names(name)), None)

    # RRA without physics would be another model than the zero mean.
    with_physics = first(
        lambda name: structures[name].uses_physics and not name.startswith(("RRA", "constant"))
    )
    without = first(lambda name: not structures[name].uses_physics)
    if with_physics and without:
        value, error = gain(with_physics, without)
        if value <= _SURE * error:
            sentences.append(
                "As far as these data tell, the physics does not help: left-out observations are "
                f"predicted no better with it ({with_physics}) than without ({value:+.1f} +- "
                f"{error:.1f} nats). Check its units and inputs, or leave it out."
            )
            return sentences
    adjusted = first(lambda name: structures[name].adjusts)
    plain = first(lambda name: name.startswith("physics mean"))
    if adjusted and plain:
        value, error = gain(adjusted, plain)
        if value <= _SURE * error:
            sentences.append(
                f"As far as these data tell, scaling the physics ({adjusted}) is no better than "
                f"the physics mean ({value:+.1f} +- {error:.1f} nats): prefer the simpler "
                "PhysicsMeanGP."
            )
    return sentences


def _or_worst(value: float) -> float:
    return value if math.isfinite(value) else -math.inf
