"""The verdict on the physics that a comparison of structures gives, and advice."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from gpadjust.models import TermsGP
from gpadjust.models.parameters import shared_parameters
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
        structure: The structure with the physics; one without unknown constants, which may help by
            themselves, if that is shown to be better.
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
        """The verdict in words: what is found, with its number, and why no more is, if so.

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
        """Why the physics is neither shown to help nor to do harm."""
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
        if sign > 0:
            return (
                f"{self.structure} is better by more than two standard errors, but its unknown "
                "constants may do that by themselves: the best structure without such constants is "
                "not shown to be better."
            )
        return (
            "That is not to say that it does not help: the difference is within two standard "
            "errors, and more observations may show one."
        )


def physics_gain(
    structures: Mapping[str, Structure],
    order: Iterable[str],
    density: Mapping[str, Tensor],
    relevance: Mapping[str, float] = MappingProxyType({}),
) -> Gain | None:
    """The gain by the physics; None if no structure uses it, or none is without it.

    Structures, log predictive densities ``n`` of left-out observations, and ``relevance``
    (probabilities that the physics is of use, of structures that were weighed without it) are by
    name, the ``order`` best first. Of a structure that was not weighed, the highest probability
    counts: of several physics one may be of use, and others not.
    """
    names = [*order]
    physical = [name for name in names if structures[name].uses_physics]
    others = [name for name in names if not structures[name].uses_physics]
    if not (physical and others):
        return None
    number = len(density[physical[0]])
    shows = number >= ENOUGH  # of fewer the error is itself unknown
    fair = next((name for name in physical if not structures[name].unknowns), physical[0])
    elpd, se = difference(density[fair], density[others[0]])
    helps = shows and sign_of(elpd, se) > 0
    if helps and relevance.get(fair, max(relevance.values(), default=1.0)) > 0.5:
        return Gain(elpd, se, fair, others[0], 1, number=number)
    elpd, se = difference(density[physical[0]], density[others[0]])
    sign = sign_of(elpd, se) if shows else 0
    by_evidence = helps if sign > 0 else sign < 0 and bool(relevance)
    shown = 0 if relevance else min(sign, 0)
    return Gain(elpd, se, physical[0], others[0], shown, by_evidence, number)


def advice(
    structures: Sequence[Structure],
    models: dict[str, TermsGP],
    left_out: dict[str, LeaveOneOut],
    converged: dict[str, Tensor],
    relevance: dict[str, Tensor],
    table: dict[str, list[Candidate]],
    X: Tensor,
) -> tuple[dict[str, Gain], list[str]]:
    """The gain by the physics of outputs where there is one without it, and sentences on all else.

    Models, predictions, ``converged`` (whether samples are of the posterior, ``m``) and
    ``relevance`` (probabilities that the physics is of use, ``m``) are by the names of structures,
    rankings by those of outputs.
    """
    by_name = {structure.name: structure for structure in structures}
    gains: dict[str, Gain] = {}
    sentences = []
    for j, (output, rows) in enumerate(table.items()):
        where = f"{output}: " if len(table) > 1 else ""
        density = dict(zip(left_out, densities(left_out, j).unbind(-1), strict=True))
        probable = {name: float(each[j]) for name, each in relevance.items()}
        order = [row.structure for row in rows]
        gain = physics_gain(by_name, order, density, probable)
        if gain is not None:
            gains[output] = gain
        found = [_best(rows)]
        if gain is None or gain.shown > 0:
            found += _scaling(by_name, order, density)
        found += [
            f"By the evidence of {name} with and without it, f_p is of use: {probability:.2f}."
            for name, probability in probable.items()
        ]
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
    return gains, sentences


def _best(rows: list[Candidate]) -> str:
    """The best structure, and those not shown to be worse."""
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
    structures: dict[str, Structure], order: list[str], density: dict[str, Tensor]
) -> list[str]:
    """The gain of scaling the physics over taking it as the mean."""
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


def _unsampled(rows: list[Candidate], converged: dict[str, Tensor], output: int) -> list[str]:
    """The structures with weight whose draws are not of their posterior."""
    names = [row.structure for row in rows if row.weight > _COUNTS]
    low = [name for name in names if not converged[name][output]]
    if not low:
        return []
    return [
        f"The samples of {', '.join(low)} are of an approximation rather than of the posterior: "
        "doubt the intervals, and fit again with more num_draws or narrower priors."
    ]


def _preferred(model: TermsGP, X: Tensor, output: int) -> list[str]:
    """The physics that a model of several relies on, and where."""
    names = getattr(model, "rho_names", ())
    if len(names) < 2:
        return []
    with torch.no_grad():
        if set(names) <= set(model.term_names):
            means = [model.term(name, X).mean for name in names]
            sizes = torch.stack([mean[:, output].abs() for mean in means])  # k x n
        else:
            constants = [abs(model.term_mean(n, output)) for n in names]
            sizes = torch.tensor(constants).unsqueeze(-1).expand(-1, len(X)).to(X)
    labels = [name.removeprefix("rho_") for name in names]
    overall = sizes.mean(-1)
    shares = ", ".join(f"{n} {w:.2g}" for n, w in zip(labels, overall.tolist(), strict=True))
    sentences = [f"Mean size of rho at the data: {shares}."]
    for i in range(X.shape[-1]):
        low = X[:, i] <= X[:, i].median()
        a, b = (int(sizes[:, part].mean(-1).argmax()) for part in (low, ~low))
        if a != b and not low.all():
            sentences.append(
                f"Below the median of {model.input_names[i]} the data prefer {labels[a]}, above it "
                f"{labels[b]}."
            )
    return sentences
