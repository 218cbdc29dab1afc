"""What the library set itself in this experiment, each with the number that decides it."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from paper.arm.results import LAST, tabulate_seconds
from paper.arm.scenarios import PAPER, SCENARIOS
from paper.control.claims import Claim, Verdict, judged, num_runs, signed
from paper.control.results import behind, curve, first_below

MEASURE = "all_steps"
TARGETS = {
    "T1": ("Dyna-CKA is at or below 8 cm (all steps) at trial 6 or before", ("cka",)),
    "T2": ("at trial 30, Dyna-CKA is the best or within 0.5 cm of the best", PAPER),
    "T3": ("a run of Dyna-CKA with its evaluations takes less than 300 s on a core", ("cka",)),
    "T4": ("f_p may be a simulator: a run of Dyna-CKA with OpenSim as f_p ends", ("cka-opensim",)),
}
COMPARED = (*PAPER, "mf-best")  # those without the previous action


@dataclass(frozen=True)
class Targets:
    """Judges the targets by the mean over runs, over all steps; an ± is a standard error.

    Args:
        trials: The records, see :func:`~paper.arm.results.load`.
        evaluations: The evaluations, see :func:`~paper.arm.results.load_evaluations`.
    """

    trials: pd.DataFrame
    evaluations: pd.DataFrame

    def judge(self) -> list[Claim]:
        """All targets; one that needs what was not run to its end is not judged."""
        full = set(self.evaluations[self.evaluations["trial"] == LAST]["scenario"])
        return judged(TARGETS, full, self._decide)

    def _decide(self, name: str) -> tuple[Verdict, str]:
        met, measured = getattr(self, f"_{name.lower()}")()
        return ("met" if met else "missed"), measured

    def _t1(self) -> tuple[bool, str]:
        by_trial = curve(self.evaluations, "cka", MEASURE)
        first = first_below(by_trial, 8)
        reached = "never" if first is None else f"at trial {first}"
        measured = f"{reached}; at 6 {by_trial[6]:.1f} cm ({num_runs(self.evaluations, 'cka')})"
        return first is not None and first <= 6, measured

    def _t2(self) -> tuple[bool, str]:
        ends = {name: curve(self.evaluations, name, MEASURE).get(LAST) for name in COMPARED}
        others = {name: end for name, end in ends.items() if end is not None and name != "cka"}
        best = min(others, key=lambda name: others[name])
        more, error = behind(self.evaluations, best, MEASURE, LAST, LAST)
        measured = (
            f"{ends['cka']:.1f} cm; the best of the others {others[best]:.1f} cm "
            f"({SCENARIOS[best].label}), {signed(more, error, 1)} of CKA's"
        )
        return ends["cka"] <= others[best] + 0.5, measured

    def _t3(self) -> tuple[bool, str]:
        row = self._seconds("cka")
        parts = ", ".join(
            f"{part} {row[f'{name}_seconds']:.0f}"
            for part, name in (
                ("fits", "fit"),
                ("model steps", "rollout"),
                ("updates", "sac"),
                ("evaluations", "evaluation"),
            )
        )
        runs = num_runs(self.evaluations, "cka")
        seconds = row["total_seconds"]
        return bool(seconds < 300), f"{seconds:.0f} s ({parts}; {runs})"

    def _t4(self) -> tuple[bool, str]:
        black_box = self.evaluations[self.evaluations["scenario"] == "cka-opensim"]
        seed = int(black_box["seed"].iloc[0])
        end = curve(black_box[black_box["seed"] == seed], "cka-opensim", MEASURE)[LAST]
        seconds = self._seconds("cka-opensim")["total_seconds"]
        measured = f"seed {seed}: {end:.1f} cm at {LAST}, {seconds:.0f} s"
        same = self.evaluations[self.evaluations["seed"] == seed]
        equation = curve(same, "cka", MEASURE).get(LAST)
        if equation is not None:
            measured += f"; with the equation of motion {equation:.1f} cm"
        return True, measured

    def _seconds(self, name: str) -> pd.Series[float]:
        table = tabulate_seconds(self.trials, self.evaluations).set_index("scenario")
        return table.drop(columns=[c for c in table if not c.endswith("_seconds")]).loc[name]
