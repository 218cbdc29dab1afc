"""The paper's claims about this experiment, each with the number that decides it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pandas as pd

from paper.control.claims import Claim, Verdict, judged, num_runs, signed
from paper.control.results import behind, curve, first_below

CLAIMS = {
    "P1": ("model-free reaches 0.5 at trial 30 and touches 0.4 by 50", ("mf",)),
    "P2": ("Dyna-Phy reaches 0.5 in 6 trials, then decays and does not recover", ("phy",)),
    "P3": ("Dyna-GP never learns", ("gp-paper",)),
    "P4": ("Dyna-CKA reaches 0.5 in 6 trials, touches 0.4 after 12, holds to 50", ("cka",)),
    "P5": ("Dyna-RRA fails in 1-25 and catches CKA in 26-50", ("rra-paper", "cka")),
}


@dataclass(frozen=True)
class Judge:
    """Judges the claims on the mean cost over runs, by trial.

    "In 6 trials" and "after 12" allow one trial more, "at trial 30" five more or less. Phy's decay
    is a mean of trials 13-25 above that of the trials from the first at 0.5 or below to 12, and no
    recovery a mean of 41-50 above 0.5. Never to learn, and to fail, is to stay above 0.5 (RRA's in
    trials 1-25). CKA holds if its mean of 41-50 is at most 0.45. RRA has caught up if its mean of
    41-50 is no more than two standard errors of the paired difference above CKA's.

    Args:
        trials: The records, see :func:`~paper.cartpole.results.load`.
        measure: ``"cost"`` of the trials as sampled, or ``"evaluation"`` of the deterministic
            policy.
    """

    trials: pd.DataFrame
    measure: str

    def judge(self) -> list[Claim]:
        """All claims; a claim about what was not run to its end is not judged."""
        full = set(self.trials[self.trials["trial"] == 50]["scenario"])
        return judged(CLAIMS, full, lambda name: getattr(self, f"_{name.lower()}")())

    def _p1(self) -> tuple[Verdict, str]:
        first, touch = self._first("mf", 0.5), self._first("mf", 0.4)
        verdict: Verdict = "not reproduced"
        if first is not None and touch is not None and first <= 35:
            verdict = "reproduced" if first >= 25 else "beaten"
        return verdict, self._described("mf") + self._beside("mf-best")

    def _p2(self) -> tuple[Verdict, str]:
        first = self._first("phy", 0.5)
        early, late = self._mean("phy", 13, 25), self._mean("phy", 41, 50)
        held = first is not None and first <= 7 and late > 0.5
        held = held and early > self._mean("phy", first or 1, 12)
        measured = f"{self._described('phy')}, mean of 13-25 {early:.3f}"
        return ("reproduced" if held else "not reproduced"), measured

    def _p3(self) -> tuple[Verdict, str]:
        verdict: Verdict = (
            "reproduced" if self._first("gp-paper", 0.5) is None else "not reproduced"
        )
        return verdict, self._described("gp-paper") + self._beside("gp")

    def _p4(self) -> tuple[Verdict, str]:
        first, touch = self._first("cka", 0.5), self._first("cka", 0.4)
        late = self._mean("cka", 41, 50)
        verdict: Verdict = "not reproduced"
        if first is not None and touch is not None and first <= 7 and touch <= 13 and late <= 0.45:
            verdict = "beaten" if first < 6 and touch < 12 and late <= 0.4 else "reproduced"
        return verdict, self._described("cka")

    def _p5(self) -> tuple[Verdict, str]:
        first = self._first("rra-paper", 0.5)
        more, error = behind(self.trials, "rra-paper", self.measure, 41, 50)
        caught = more <= 2 * (0 if math.isnan(error) else error)
        failed = first is None or first > 25
        measured = (
            f"{self._described('rra-paper')}, {signed(more, error)} of CKA's{self._beside('rra')}"
        )
        return ("reproduced" if failed and caught else "not reproduced"), measured

    def _first(self, name: str, threshold: float) -> int | None:
        return first_below(curve(self.trials, name, self.measure), threshold)

    def _mean(self, name: str, first: int, last: int) -> float:
        return float(curve(self.trials, name, self.measure).loc[first:last].mean())

    def _described(self, name: str) -> str:
        parts = []
        for threshold in (0.5, 0.4):
            first = self._first(name, threshold)
            parts.append(f"{threshold} {'never' if first is None else f'at trial {first}'}")
        late = f"mean of 41-50 {self._mean(name, 41, 50):.3f}"
        return f"{', '.join(parts)}, {late} ({num_runs(self.trials, name)})"

    def _beside(self, name: str) -> str:
        if not (self.trials["scenario"] == name).any():
            return ""
        return f"; {name}: {self._described(name)}"
