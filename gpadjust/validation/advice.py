"""What a comparison of structures says about the physics, in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import torch
from torch import Tensor

from gpadjust.models import TermsGP
from gpadjust.models.parameters import shared_parameters
from gpadjust.validation.gain import Gain, physics_gain
from gpadjust.validation.leave_one_out import LeaveOneOut
from gpadjust.validation.ranking import ENOUGH, SURE, Candidate, densities, difference, sign_of
from gpadjust.validation.structures import Structure

_COUNTS = 0.05  # weight with which a structure is a part of what is recommended


def advice(
    structures: Sequence[Structure],
    models: dict[str, TermsGP],
    left_out: dict[str, LeaveOneOut],
    converged: dict[str, Tensor],
    relevance: dict[str, Tensor],
    table: dict[str, list[Candidate]],
    X: Tensor,
) -> list[str]:
    """Sentences for each output, and what holds for all.

    Args:
        structures: What was fitted.
        models: The models by the names of their structures.
        left_out: Their leave-one-out predictions.
        converged: Whether their samples are of the posterior, ``m`` each.
        relevance: Probabilities that the physics is of use, ``m``, of the structures that say it.
        table: The rankings, by the names of the outputs.
        X: Training inputs, ``n x d``.
    """
    by_name = {structure.name: structure for structure in structures}
    sentences = []
    for j, (output, rows) in enumerate(table.items()):
        where = f"{output}: " if len(table) > 1 else ""
        density = _density(left_out, j)
        probable = {name: float(each[j]) for name, each in relevance.items()}
        order = [row.structure for row in rows]
        found = [_best(rows), *_gains(by_name, order, density, probable)]
        found += [_of_use(name, probability) for name, probability in probable.items()]
        found += _preferred(models[rows[0].structure], X, j)
        found += _unsampled(rows, converged, j)
        sentences += [where + sentence for sentence in found]
    flattered = [name for name, model in models.items() if shared_parameters(model)]
    if flattered:
        sentences.append(
            f"{', '.join(flattered)}: left-out observations have had their say in the parameters "
            "of the physics, so that these elpd are too high. Freeze them with "
            "requires_grad_(False) for a fair comparison."
        )
    return sentences


def _best(rows: list[Candidate]) -> str:
    """Which structure is best, and how sure that is."""
    best, *others = rows
    near = [row for row in others if not sign_of(row.elpd_diff, row.se_diff)]
    sentence = f"{best.structure} predicts left-out observations best (weight {best.weight:.2f})"
    if not near:
        return f"{sentence}."
    return (
        f"{sentence}; not shown to be worse, within {SURE:.0f} standard errors: "
        f"{', '.join(row.structure for row in near)}."
    )


def gains(
    structures: Sequence[Structure],
    left_out: dict[str, LeaveOneOut],
    relevance: dict[str, Tensor],
    table: dict[str, list[Candidate]],
) -> dict[str, Gain]:
    """What the physics is worth to each output, if there are structures with and without it."""
    by_name = {structure.name: structure for structure in structures}
    found = {}
    for j, (output, rows) in enumerate(table.items()):
        order = [row.structure for row in rows]
        probable = {name: float(each[j]) for name, each in relevance.items()}
        found[output] = physics_gain(by_name, order, _density(left_out, j), probable)
    return {output: gain for output, gain in found.items() if gain is not None}


def _density(left_out: dict[str, LeaveOneOut], output: int) -> dict[str, Tensor]:
    """The log predictive densities of an output's observations by each structure, ``n``."""
    return dict(zip(left_out, densities(left_out, output).unbind(-1), strict=True))


def _of_use(structure: str, probability: float) -> str:
    return f"By the evidence of {structure} with and without it, f_p is of use: {probability:.2f}."


def _gains(
    structures: dict[str, Structure],
    order: list[str],
    density: dict[str, Tensor],
    relevance: Mapping[str, float] = MappingProxyType({}),
) -> list[str]:
    """Whether the physics helps, and whether scaling it does."""
    sentences = []
    physics = physics_gain(structures, order, density, relevance)
    if physics is not None:
        text = _elpd(physics.elpd, physics.se, physics.structure, "without it", physics.without)
        if physics.shown <= 0:
            says = "makes predictions worse" if physics.shown < 0 else "is not shown to help"
            enough = len(density[physics.structure]) >= ENOUGH
            by_constants = enough and sign_of(physics.elpd, physics.se) > 0
            why = "; its unknown constants may do so by themselves" if by_constants else ""
            if physics.by_evidence and by_constants:
                why = "; the evidence does not agree"
            return [f"The physics {says}: {text}{why}."]
        sentences.append(f"The physics helps: {text}.")
    adjusting = next((name for name in order if structures[name].adjusts), None)
    plain = next((n for n in order if structures[n].uses_physics and not structures[n].adjusts), "")
    if adjusting is not None and plain:
        value, error = difference(density[adjusting], density[plain])
        says = "helps" if sign_of(value, error) > 0 else "is not shown to help"
        text = _elpd(value, error, adjusting, "with the physics as a mean", plain)
        sentences.append(f"Scaling the physics {says}: {text}.")
    return sentences


def _elpd(value: float, error: float, better: str, otherwise: str, worse: str) -> str:
    nats = f"{round(value, 1) + 0.0:+.1f} +- {error:.1f} nats"
    return f"elpd {nats} ({better}) over that {otherwise} ({worse})"


def _unsampled(rows: list[Candidate], converged: dict[str, Tensor], output: int) -> list[str]:
    """Which of the structures that count are known by draws that are not of their posterior."""
    names = [row.structure for row in rows if row.weight > _COUNTS]
    low = [name for name in names if not converged[name][output]]
    if not low:
        return []
    return [
        f"The samples of {', '.join(low)} are of an approximation rather than of the posterior: "
        "doubt the intervals, and fit again with more num_draws or narrower priors."
    ]


def _preferred(model: TermsGP, X: Tensor, output: int) -> list[str]:
    """Which physics a model of several relies on, and where."""
    names = getattr(model, "rho_names", ())
    if len(names) < 2:
        return []
    with torch.no_grad():
        if set(names) <= set(model.term_names):
            sizes = torch.stack([_mean_of(model, n, X)[:, output].abs() for n in names])  # k x n
        else:
            constants = [abs(model.term_mean(n, output)) for n in names]
            sizes = torch.tensor(constants).unsqueeze(-1).expand(-1, len(X)).to(X)
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


def _mean_of(model: TermsGP, term: str, X: Tensor) -> Tensor:
    """The posterior mean of a term, ``n x m``."""
    mean: Tensor = model.term(term, X).mean
    return mean
