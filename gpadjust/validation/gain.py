"""What the physics is worth to an output."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from torch import Tensor

from gpadjust.validation.ranking import ENOUGH, difference, sign_of
from gpadjust.validation.structures import Structure


class Gain(NamedTuple):
    """By how much an output is predicted better with the physics than without it.

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
    """

    elpd: float
    se: float
    structure: str
    without: str
    shown: int
    by_evidence: bool = False


def physics_gain(
    structures: Mapping[str, Structure],
    order: Iterable[str],
    density: Mapping[str, Tensor],
    relevance: Mapping[str, float] = MappingProxyType({}),
) -> Gain | None:
    """What the physics is worth; None if there is nothing with it, or nothing without it.

    Args:
        structures: The structures by their names.
        order: The names, best first.
        density: The log predictive densities of left-out observations by each, ``n``.
        relevance: Probabilities that the physics is of use, of the structures that were weighed
            without it. Of a structure that was not, the highest one counts: of several physics one
            may be of use, and others not.
    """
    names = [*order]
    physical = [name for name in names if structures[name].uses_physics]
    others = [name for name in names if not structures[name].uses_physics]
    if not (physical and others):
        return None
    shows = len(density[physical[0]]) >= ENOUGH  # of fewer the error is itself unknown
    fair = next((name for name in physical if not structures[name].unknowns), physical[0])
    elpd, se = difference(density[fair], density[others[0]])
    helps = shows and sign_of(elpd, se) > 0
    if helps and relevance.get(fair, max(relevance.values(), default=1.0)) > 0.5:
        return Gain(elpd, se, fair, others[0], 1)
    elpd, se = difference(density[physical[0]], density[others[0]])
    sign = sign_of(elpd, se) if shows else 0
    by_evidence = helps if sign > 0 else sign < 0 and bool(relevance)
    shown = 0 if relevance else min(sign, 0)
    return Gain(elpd, se, physical[0], others[0], shown, by_evidence)
