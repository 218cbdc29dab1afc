"""What was aimed at, and what was found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import pandas as pd

from paper.common.claims import Judged, met
from paper.real import SMOOTHED

OURS = {
    "phymean": "phy",
    "phymean-identified": "phy-identified",
    "phymean-fitted": "fitted",
    "cka": "phy",
    "cka-identified": "phy-identified",
    "rra": "phy",
    "rra-identified": "phy-identified",
}
"""Learners of f_p and a GP, and the f_p alone that they adjust."""

CALIBRATED = (
    *("calibrated-delta", "calibrated-cka", "calibrated-orthogonal"),
    *("smoothed-delta", "smoothed-cka"),
)
"""Learners of a GP and of f_p's parameters at once; they are judged as soon as they are run."""

_NEAR, _FAR = ("double-pendulum", "near"), ("double-pendulum", "far")
_ERRORS = ("rmse-1", "rmse-10", "rmse-20", "rmse-40")
_BETWEEN = ("coverage-10", "coverage-20")
_LEAST = 50  # transitions of what is compared with f_p alone and the GP

_Cell = tuple[str, str, str, int]
_Pair = tuple[_Cell, list[_Cell]]


def verdicts(means: pd.DataFrame) -> list[Judged]:
    """The verdict on each target.

    Args:
        means: Of the scores over the runs, by system, test, learner and n.
    """
    found = _Means(means)
    ours = [*OURS, *CALIBRATED]
    by_crude, by_identified = (
        [name for name, physics in OURS.items() if physics == known]
        for known in ("phy", "phy-identified")
    )
    smaller = [((*cell[:3], most), [(*cell[:3], 100)]) for cell, most in found.largest(ours)]
    fitted = found.beside(["phymean-fitted", *CALIBRATED], ["fitted"])
    contained = [
        pair
        for name in ours
        for pair in found.beside([name], [_alone(name), "gp"])
        if pair[0][3] >= _LEAST
    ]
    pendulum = [
        pair
        for pair in found.beside(CALIBRATED, ["gp", "fitted"])
        if pair[0][0].startswith("pendulum")
    ]
    near = "double pendulum, near, n = 100, second angle after 1 s: at most"
    return [
        found.lowest("R1", f"{near} 0.06 rad by the crude f_p", by_crude, _NEAR, 0.06),
        found.lowest("R2", f"{near} 0.042 rad by the identified", by_identified, _NEAR, 0.042),
        found.lowest("R3", f"{near} 0.036 rad by a calibrated", CALIBRATED, _NEAR, 0.036),
        found.lowest("R4", "the same, far: at most 0.16 rad", CALIBRATED, _FAR, 0.16),
        found.never_worse("R5", "most transitions never worse than 100 by over 5 %", smaller, 1.05),
        found.never_worse("R6", "a GP on a fitted f_p never worse by over 5 %", fitted, 1.05),
        found.never_worse(
            "R7",
            f"never worse than the better of f_p alone and GP by over 10 %, n >= {_LEAST}",
            contained,
            1.1,
        ),
        found.within("R8", "near, 0.5 and 1 s: coverage", ours, _NEAR, _BETWEEN, 0.9, 0.98),
        found.within("R9", "far, 0.5 and 1 s: coverage", ours, _FAR, _BETWEEN, 0.85, 1.0),
        found.within("R10", "near, a step: coverage", ours, _NEAR, ("coverage-1",), 0.9, 0.98),
        found.never_worse(
            "R11", "pendulum: a calibrated f_p never worse than GP and fitted f_p", pendulum, 1.0
        ),
        found.lowest(
            "R12",
            "nine parameters with delta, n = 100: a fit takes at most 5 s",
            CALIBRATED[:1],
            _NEAR,
            5.0,
            "fit_seconds",
        ),
    ]


def _alone(name: str) -> str:
    """The learner of f_p alone that a learner of ours adjusts."""
    return OURS.get(name, "smoothed" if name in SMOOTHED else "calibrated")


@dataclass(frozen=True)
class _Means:
    """Means over the runs, and targets that are judged by them.

    Args:
        table: By system, test, learner and n.
    """

    table: pd.DataFrame

    def largest(self, learners: Sequence[str]) -> Iterator[tuple[_Cell, int]]:
        """Cells of 100 transitions of some learners, and the most that they have learnt from."""
        for cell in self._cells(learners):
            most = max(other[3] for other in self.table.index if other[:3] == cell[:3])
            if cell[3] == 100 < most:
                yield cell, most

    def beside(self, learners: Sequence[str], others: Sequence[str]) -> list[_Pair]:
        """Cells of some learners, each with the same of others, if they were run."""
        found = []
        for system, test, learner, n in self._cells(learners):
            same = [(system, test, other, n) for other in others]
            if all(cell in self.table.index for cell in same):
                found.append(((system, test, learner, n), same))
        return found

    def lowest(
        self,
        name: str,
        claim: str,
        learners: Sequence[str],
        place: tuple[str, str],
        most: float,
        column: str = "rmse-20",
    ) -> Judged:
        """Whether the best of some learners is low enough, of 100 transitions."""
        cells = [cell for cell in self._cells(learners) if (*cell[:2], cell[3]) == (*place, 100)]
        if not cells:
            return Judged(name, claim, "not run", f"no results of {', '.join(learners)}")
        values = {cell[2]: float(self.table.loc[cell, column]) for cell in cells}
        text = ", ".join(f"{learner} {value:.3g}" for learner, value in values.items())
        return Judged(name, claim, met(min(values.values()) <= most), text)

    def never_worse(self, name: str, claim: str, pairs: Sequence[_Pair], most: float) -> Judged:
        """Whether errors of cells are within a factor of the least of others, all horizons."""
        ratios = {
            (*cell, column): float(
                self.table.loc[cell, column]
                / min(self.table.loc[other, column] for other in others)
            )
            for cell, others in pairs
            for column in _ERRORS
            if column in self.table
        }
        if not ratios:
            return Judged(name, claim, "not run", "no results of these learners")
        held = sum(ratio <= most for ratio in ratios.values())
        worst = max(ratios, key=lambda cell: ratios[cell])
        at = f"{' '.join(worst[:3])}, n = {worst[3]}, {worst[4]}"
        text = f"held in {held} of {len(ratios)} cells; the worst, {ratios[worst]:.2f} times: {at}"
        return Judged(name, claim, met(held == len(ratios)), text)

    def within(
        self,
        name: str,
        claim: str,
        learners: Sequence[str],
        place: tuple[str, str],
        columns: Sequence[str],
        low: float,
        high: float,
    ) -> Judged:
        """Whether scores of a test are between two bounds."""
        claim = f"{claim} in [{low:g}, {high:g}]"
        found = {
            (*cell, column): float(self.table.loc[cell, column])
            for cell in self._cells(learners)
            for column in columns
            if cell[:2] == place and column in self.table
        }
        if not found:
            return Judged(name, claim, "not run", "no results of these learners")
        held = sum(low <= value <= high for value in found.values())
        ends = f"from {min(found.values()):.2f} to {max(found.values()):.2f}"
        return Judged(
            name, claim, met(held == len(found)), f"held in {held} of {len(found)}, {ends}"
        )

    def _cells(self, learners: Sequence[str]) -> Iterator[_Cell]:
        for system, test, learner, n in self.table.index:
            if learner in learners:
                yield system, test, learner, n
