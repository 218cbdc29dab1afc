"""Targets of the learners of real machines, and their verdicts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import pandas as pd

from paper.common.verdicts import Judged, met

# Learners of f_p and a GP with the f_p alone that they adjust. Those of f_p's parameters and a GP
# at once are judged as soon as they are run.
_OURS = {
    **dict.fromkeys(("phymean", "cka", "rra"), "phy"),
    **dict.fromkeys(("phymean-identified", "cka-identified", "rra-identified"), "phy-identified"),
    "phymean-fitted": "fitted",
}
_CALIBRATED = {
    **dict.fromkeys(("calibrated-delta", "calibrated-cka", "calibrated-orthogonal"), "calibrated"),
    **dict.fromkeys(("smoothed-delta", "smoothed-cka"), "smoothed"),
}
ALONE = {**_OURS, **_CALIBRATED}
_NEAR, _FAR = ("double-pendulum", "near"), ("double-pendulum", "far")
_ERRORS = ("rmse-1", "rmse-10", "rmse-20", "rmse-40")
_Ratios = Iterator[tuple[tuple[Any, ...], float]]


def verdicts(means: pd.DataFrame) -> list[Judged]:
    """The verdict on each target, by means over the runs by system, test, learner and n."""
    order = ("phymean", "phymean-identified", "phymean-fitted", "cka", "cka-identified", "rra")
    ours = [*order, "rra-identified", *_CALIBRATED]
    by_crude, by_identified = (
        [name for name in ours if ALONE[name] == known] for known in ("phy", "phy-identified")
    )

    def lowest(
        id: str,
        claim: str,
        learners: Sequence[str],
        place: Any,
        most: float,
        column: str = "rmse-20",
    ) -> Judged:
        """Verdict: the best of some learners is low enough, of 100 transitions."""
        values = {
            learner: float(means.loc[(system, test, learner, n), column])
            for system, test, learner, n in means.index
            if learner in learners and (system, test) == place and n == 100
        }
        if not values:
            return Judged(id, claim, "not run", f"no results of {', '.join(learners)}")
        text = ", ".join(f"{learner} {value:.3g}" for learner, value in values.items())
        return Judged(id, claim, met(min(values.values()) <= most), text)

    def ratios(learners: Sequence[str], others: Any, least: int = 0, system: str = "") -> _Ratios:
        """Errors of cells by the least of others, at all horizons."""
        for cell in means.index:
            if cell[2] not in learners or cell[3] < least or not cell[0].startswith(system):
                continue
            beside = others(cell)
            if beside and all(other in means.index for other in beside):
                for column in _ERRORS:
                    if column in means:
                        best = min(means.loc[other, column] for other in beside)
                        yield (*cell, column), float(means.loc[cell, column] / best)

    def never_worse(id: str, claim: str, found: _Ratios, most: float) -> Judged:
        by_cell = dict(found)
        if not by_cell:
            return Judged(id, claim, "not run", "no results of these learners")
        held = sum(ratio <= most for ratio in by_cell.values())
        worst = max(by_cell, key=lambda cell: by_cell[cell])
        at = f"{' '.join(worst[:3])}, n = {worst[3]}, {worst[4]}"
        text = (
            f"held in {held} of {len(by_cell)} cells; the worst, {by_cell[worst]:.2f} times: {at}"
        )
        return Judged(id, claim, met(held == len(by_cell)), text)

    def within(
        id: str, claim: str, place: Any, columns: Sequence[str], low: float, high: float
    ) -> Judged:
        claim = f"{claim} in [{low:g}, {high:g}]"
        found = [
            float(means.loc[cell, column])
            for cell in means.index
            for column in columns
            if cell[2] in ours and cell[:2] == place and column in means
        ]
        if not found:
            return Judged(id, claim, "not run", "no results of these learners")
        held = sum(low <= value <= high for value in found)
        text = f"held in {held} of {len(found)}, from {min(found):.2f} to {max(found):.2f}"
        return Judged(id, claim, met(held == len(found)), text)

    def same(*learners: str) -> Any:
        """The same cell of other learners."""
        return lambda cell: [(*cell[:2], learner, cell[3]) for learner in learners]

    def larger(learners: Sequence[str]) -> _Ratios:
        """Errors of the most transitions by those of 100."""
        most = {
            cell: max(other[3] for other in means.index if other[:3] == cell[:3])
            for cell in means.index
            if cell[2] in learners and cell[3] == 100
        }
        for cell, n in most.items():
            if n > 100:
                yield from (
                    ((*cell[:3], n, c), float(means.loc[(*cell[:3], n), c] / means.loc[cell, c]))
                    for c in _ERRORS
                    if c in means
                )

    near = "double pendulum, near, n = 100, second angle after 1 s: at most"
    calibrated = [*_CALIBRATED]
    fitted = ratios(["phymean-fitted", *calibrated], same("fitted"))
    contained = ratios(ours, lambda cell: same(ALONE[cell[2]], "gp")(cell), 50)
    pendulum = ratios(calibrated, same("gp", "fitted"), system="pendulum")
    between = ("coverage-10", "coverage-20")
    better = "never worse than the better of f_p alone and GP by over 10 %, n >= 50"
    fit = "nine parameters with delta, n = 100: a fit takes at most 5 s"
    return [
        lowest("R1", f"{near} 0.06 rad by the crude f_p", by_crude, _NEAR, 0.06),
        lowest("R2", f"{near} 0.042 rad by the identified", by_identified, _NEAR, 0.042),
        lowest("R3", f"{near} 0.036 rad by a calibrated", calibrated, _NEAR, 0.036),
        lowest("R4", "the same, far: at most 0.16 rad", calibrated, _FAR, 0.16),
        never_worse("R5", "most transitions never worse than 100 by over 5 %", larger(ours), 1.05),
        never_worse("R6", "a GP on a fitted f_p never worse by over 5 %", fitted, 1.05),
        never_worse("R7", better, contained, 1.1),
        within("R8", "near, 0.5 and 1 s: coverage", _NEAR, between, 0.9, 0.98),
        within("R9", "far, 0.5 and 1 s: coverage", _FAR, between, 0.85, 1.0),
        within("R10", "near, a step: coverage", _NEAR, ("coverage-1",), 0.9, 0.98),
        never_worse(
            "R11", "pendulum: a calibrated f_p never worse than GP and fitted f_p", pendulum, 1.0
        ),
        lowest("R12", fit, calibrated[:1], _NEAR, 5.0, "fit_seconds"),
    ]
