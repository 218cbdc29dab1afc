"""The verdict on the physics that a comparison of structures gives, and advice."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.core import GP, FitResult
from gpadjust.validation.leave_one_out import LeaveOneOut
from gpadjust.validation.ranking import ENOUGH, SURE, Candidate, densities, difference, sign_of
from gpadjust.validation.structures import Structure

_COUNTS = 0.05  # weight with which a structure is a part of what is recommended
_ANSWERS = {1: "Yes", 0: "Not shown", -1: "No"}


class Gain(NamedTuple):
    """The gain of predictions of an output by the physics, and the verdict on it.

    Attributes:
        elpd: The difference of expected log predictive densities, the sum over the observations, in
            nats.
        se: Its standard error.
        structure: The structure with the physics.
        without: The structure without the physics.
        shown: 1 if the physics is shown to help, by two standard errors and by the evidence of
            models that were weighed without it; -1 if it is shown to make predictions worse, where
            no model leaves it out by itself; 0 if neither is, or there are observations of fewer
            than eight different inputs.
        by_evidence: Whether a difference of more than two standard errors shows nothing because of
            models that were weighed without the physics.
        number: The number of observations, those of the same inputs taken together.
    """

    elpd: float
    se: float
    structure: str
    without: str
    shown: int
    by_evidence: bool = False
    number: int = ENOUGH

    @property
    def answer(self) -> str:
        """``"Yes"``, ``"Not shown"`` or ``"No"``: does the physics help?"""
        return _ANSWERS[self.shown]

    def sentences(self, output: str) -> list[str]:
        """Return the verdict in words: what is found, with its number, and why no more is, if so.

        Args:
            output: The name of the output.
        """
        found = {1: f"The physics helps to predict {output}"}
        found[-1] = f"With the physics, {output} is predicted worse than without it"
        found[0] = f"These data do not show whether the physics helps to predict {output}"
        text = _elpd(self.elpd, self.se, self.structure, "without it", self.without)
        ratio = math.exp(max(-50.0, min(50.0, self.elpd / self.number)))
        each = f"each of {self.number} left-out observations is {ratio:.3g} times as likely"
        finding = f"{found[self.shown]}: {text}; {each} in geometric mean."
        return [finding] if self.shown else [finding, self._reason()]

    def _reason(self) -> str:
        """Return why the physics is neither shown to help nor to do harm."""
        sign = sign_of(self.elpd, self.se)
        if self.number < ENOUGH:
            return (
                f"Of fewer than {ENOUGH} observations the standard error is itself unknown: "
                "neither is it shown that the physics helps, nor that it does not."
            )
        if self.by_evidence and sign > 0:
            return (
                f"{self.structure} is better by more than two standard errors, but by the evidence "
                "of a model with and without the physics it is of no use: as the two do not agree, "
                "nothing is shown."
            )
        if self.by_evidence:
            return (
                f"{self.structure} is worse by more than two standard errors, but among those "
                "compared is a model that leaves a physics of no use out by itself: so none is "
                "said to do harm."
            )
        return (
            "That is not to say that it does not help: the difference is within two standard "
            "errors, and more observations may show one."
        )


def physics_gain(
    structures: Mapping[str, Structure],
    order: Iterable[str],
    density: Mapping[str, Tensor],
    relevance: Mapping[str, float],
) -> Gain | None:
    """Return the gain by the physics; None if no structure uses it, or all do.

    Structures, log predictive densities ``n`` of left-out observations, and ``relevance``
    (probabilities that the physics is of use, of models that are averaged with one without it) are
    by name, the ``order`` best first. Of a structure without such a probability the highest one
    counts: of several physics one may be of use, and others not.
    """
    names = [*order]
    physical = [name for name in names if structures[name].uses_physics]
    others = [name for name in names if not structures[name].uses_physics]
    if not (physical and others):
        return None
    best, without = physical[0], others[0]
    number = len(density[best])
    elpd, se = difference(density[best], density[without])
    sign = sign_of(elpd, se) if number >= ENOUGH else 0  # of fewer the error is itself unknown
    probability = relevance.get(best, max(relevance.values(), default=1.0))
    is_doubted = probability <= 0.5 if sign > 0 else bool(relevance)
    by_evidence = bool(sign) and is_doubted
    return Gain(elpd, se, best, without, 0 if by_evidence else sign, by_evidence, number)


def relevance_of(model: GP, result: FitResult) -> list[float]:
    """Return the probability that the physics is of use, of each output; empty if not asked."""
    without = [c.text for c in model.table.choices if any(z.endswith(".mean") for z in c.zeros)]
    shares = [result.probabilities[text] for text in without if text in result.probabilities]
    return [1 - sum(each) for each in zip(*shares, strict=True)]


def advice(
    structures: Sequence[Structure],
    models: Mapping[str, GP],
    results: Mapping[str, FitResult],
    left_out: Mapping[str, LeaveOneOut],
    table: Mapping[str, list[Candidate]],
) -> tuple[dict[str, Gain], list[str]]:
    """Return the gain by the physics of each output where there is one, and all else in sentences.

    Models, results of their fits and predictions are by the names of structures, rankings by the
    names of outputs.
    """
    named = {structure.name: structure for structure in structures}
    relevance = {name: relevance_of(model, results[name]) for name, model in models.items()}
    gains: dict[str, Gain] = {}
    sentences = []
    for j, (output, rows) in enumerate(table.items()):
        where = f"{output}: " if len(table) > 1 else ""
        density = dict(zip(left_out, densities(left_out, j).unbind(-1), strict=True))
        probable = {name: each[j] for name, each in relevance.items() if each}
        order = [row.structure for row in rows]
        gain = physics_gain(named, order, density, probable)
        if gain is not None:
            gains[output] = gain
        found = [_best(rows)]
        if gain is None or gain.shown > 0:
            found += _scaling(named, order, density)
        found += [
            f"By the evidence of {name} with and without it, f_p is of use: {probability:.2f}."
            for name, probability in probable.items()
        ]
        found += _preferred(models[order[0]], j)
        sentences += [where + sentence for sentence in found]
    return gains, sentences + _unsampled(table, results)


def _best(rows: list[Candidate]) -> str:
    """Return the best structure, and those not shown to be worse."""
    best, *others = rows
    near = [row for row in others if not sign_of(row.elpd_diff, row.se_diff)]
    sentence = f"{best.structure} predicts left-out observations best (weight {best.weight:.2f})"
    if not near:
        return f"{sentence}."
    return (
        f"{sentence}; not shown to be worse, within {SURE:.0f} standard errors: "
        f"{', '.join(row.structure for row in near)}."
    )


def _scaling(
    structures: Mapping[str, Structure], order: Sequence[str], density: Mapping[str, Tensor]
) -> list[str]:
    """Return the gain of scaling the physics over taking it as the mean."""
    adjusting = next((name for name in order if structures[name].adjusts), None)
    plain = next((n for n in order if structures[n].uses_physics and not structures[n].adjusts), "")
    if adjusting is None or not plain:
        return []
    value, error = difference(density[adjusting], density[plain])
    says = "helps" if sign_of(value, error) > 0 else "is not shown to help"
    text = _elpd(value, error, adjusting, "with the physics as a mean", plain)
    return [f"Scaling the physics {says}: {text}."]


def _elpd(value: float, error: float, better: str, otherwise: str, worse: str) -> str:
    nats = f"{round(value, 1) + 0.0:+.1f} +- {error:.1f} nats"
    return f"elpd {nats} ({better}) over that {otherwise} ({worse})"


def _unsampled(table: Mapping[str, list[Candidate]], results: Mapping[str, FitResult]) -> list[str]:
    """Return which structures with weight have other results by other seeds."""
    names = {row.structure for rows in table.values() for row in rows if row.weight > _COUNTS}
    low = [name for name, result in results.items() if name in names and not result.converged]
    if not low:
        return []
    return [
        f"Results of {', '.join(low)} depend on the seed: doubt the intervals, and fit again "
        "with more num_draws or narrower priors."
    ]


def _preferred(model: GP, output: int) -> list[str]:
    """Return which physics a model of several relies on, and where."""
    names, X = [t.name for t in model.terms if t.physics is not None], model.data.X
    if len(names) < 2:
        return []
    with torch.no_grad():
        means = [model.term(name, X).mean[:, output].abs() for name in names]
    sizes = torch.stack(means)  # k x n
    labels = [name.removeprefix("rho_") for name in names]
    shares = zip(labels, sizes.mean(-1).tolist(), strict=True)
    sentences = [
        f"Mean size of rho at the data: {', '.join(f'{n} {share:.2g}' for n, share in shares)}."
    ]
    for i in range(X.shape[-1]):
        low = X[:, i] <= X[:, i].median()
        a, b = (int(sizes[:, part].mean(-1).argmax()) for part in (low, ~low))
        if a != b and not low.all():
            sentences.append(
                f"Below the median of {model.data.input_names[i]} the data prefer {labels[a]}, "
                f"above it {labels[b]}."
            )
    return sentences
