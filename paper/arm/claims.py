"""The paper's claims about this experiment, each with the number that decides it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd

from gpadjust.envs import arm_targets, hand_position
from gpadjust.envs.arm_task import START_MEAN
from paper.arm.results import LAST, spread
from paper.arm.scenarios import PAPER, SCENARIOS
from paper.control.claims import Claim, Verdict, judged, num_runs, signed
from paper.control.results import behind, curve, first_below, window

CLAIMS = {
    "A1": ("model-free ends at about 8 cm", ("mf",)),
    "A2": ("Dyna-GP learns faster than model-free, but stays above 10 cm", ("gp", "mf")),
    "A3": ("Dyna-Phy reaches 10 cm by trial 12, then is slow", ("phy",)),
    "A4": ("Dyna-CKA reaches 8 cm by trial 3, ends at about 6, with least variance", PAPER),
    "A5": ("Dyna-RRA is as fast as Dyna-Phy and catches CKA by trial 24", ("rra", "phy", "cka")),
    "A6": (
        "after trial 9, CKA is low at nearly all targets, model-free only near the start",
        ("cka", "mf"),
    ),
}
MAP_TRIAL = 9
LOW = 10.0  # cm: what is called a low error at a target


def distance_from_start() -> np.ndarray:
    """How far each target is from the hand at the start, in cm: ``121``."""
    start = hand_position(arm_targets().new_tensor(START_MEAN))
    gap = hand_position(arm_targets()) - start
    return 100 * gap.square().sum(-1).sqrt().numpy()


@dataclass(frozen=True)
class Judge:
    """Judges the claims on the hand's root mean square distance over targets, mean over runs.

    "About" is 1 cm more or less, "beaten" below that. Faster is a lower mean over the evaluations
    of trials 3 to 12; slow, to lose less than 2 cm from trial 12 to 30; as fast, to reach 10 cm no
    later than an evaluation (3 trials) after. The variance is the standard deviation over runs,
    averaged over evaluations from trial 3. RRA has caught up if its mean of 24-30 is no more than
    two standard errors of the paired difference above CKA's. Low is at most 10 cm at a target, on
    average over the runs; nearly all, nine in ten; only near the start, less than half, and these
    nearer to where the hand starts than the others on average.

    Args:
        evaluations: The evaluations, see :func:`~paper.arm.results.load_evaluations`.
        maps: The errors at each target, see :func:`~paper.arm.results.load_maps`.
        measure: ``"all_steps"`` or ``"last_five"``.
    """

    evaluations: pd.DataFrame
    maps: pd.DataFrame
    measure: str

    def judge(self) -> list[Claim]:
        """All claims; a claim about what was not run to its end is not judged."""
        full = set(self.evaluations[self.evaluations["trial"] == LAST]["scenario"])
        return judged(CLAIMS, full, lambda name: getattr(self, f"_{name.lower()}")())

    def _a1(self) -> tuple[Verdict, str]:
        end = self._at("mf", LAST)
        verdict: Verdict = "beaten" if end < 7 else "reproduced" if end <= 9 else "not reproduced"
        return verdict, self._described("mf") + self._beside("mf-best")

    def _a2(self) -> tuple[Verdict, str]:
        early = {name: self._mean(name, 3, 12) for name in ("gp", "mf")}
        lowest = curve(self.evaluations, "gp", self.measure).min()
        held = early["gp"] < early["mf"] and lowest > 10
        measured = (
            f"mean of 3-12 {early['gp']:.1f} cm against {early['mf']:.1f}, {self._described('gp')}"
        )
        return ("reproduced" if held else "not reproduced"), measured

    def _a3(self) -> tuple[Verdict, str]:
        first = self._first("phy", 10)
        held = first is not None and first <= 12
        held = held and self._at("phy", 12) - self._at("phy", LAST) < 2
        measured = f"{self._described('phy')}, at 12 {self._at('phy', 12):.1f} cm"
        return ("reproduced" if held else "not reproduced"), measured

    def _a4(self) -> tuple[Verdict, str]:
        first, end = self._first("cka", 8), self._at("cka", LAST)
        spreads = {name: self._spread(name) for name in PAPER}
        least = min(spreads, key=lambda name: spreads[name])
        verdict: Verdict = "not reproduced"
        if first is not None and first <= 3 and end <= 7 and least == "cka":
            verdict = "beaten" if end < 5 else "reproduced"
        measured = f"{self._described('cka')}, sd over runs {spreads['cka']:.1f} cm"
        if not math.isnan(spreads["cka"]):
            others = min((name for name in PAPER if name != "cka"), key=lambda name: spreads[name])
            measured += f", the least of the others {spreads[others]:.1f} ({self._label(others)})"
        return verdict, measured

    def _a5(self) -> tuple[Verdict, str]:
        first, phy = self._first("rra", 10), self._first("phy", 10)
        more, error = behind(self.evaluations, "rra", self.measure, 24, LAST)
        caught = more <= 2 * (0 if math.isnan(error) else error)
        fast = first is not None and first <= (LAST if phy is None else phy) + 3
        measured = (
            f"{self._described('rra')}, Phy {self._reached('phy', 10)}, "
            f"{signed(more, error, 1)} cm of CKA's in 24-30"
        )
        return ("reproduced" if fast and caught else "not reproduced"), measured

    def _a6(self) -> tuple[Verdict, str]:
        low = {name: self._low(name) for name in ("cka", "mf")}
        near = self._far[low["mf"]].mean() if low["mf"].any() else 0.0
        far = self._far[~low["mf"]].mean() if not low["mf"].all() else 0.0
        held = low["cka"].mean() >= 0.9 and low["mf"].mean() < 0.5 and near < far
        measured = (
            f"at most {LOW:g} cm at {low['cka'].sum()} of 121 targets by CKA, at "
            f"{low['mf'].sum()} by model-free, these {near:.0f} cm from the start, the others "
            f"{far:.0f} cm"
        )
        return ("reproduced" if held else "not reproduced"), measured

    @cached_property
    def _far(self) -> np.ndarray:
        return distance_from_start()

    def _low(self, name: str) -> np.ndarray:
        chosen = self.maps[(self.maps["scenario"] == name) & (self.maps["trial"] == MAP_TRIAL)]
        return np.asarray(chosen.groupby("target")[self.measure].mean() <= LOW)

    def _first(self, name: str, threshold: float) -> int | None:
        return first_below(curve(self.evaluations, name, self.measure), threshold)

    def _at(self, name: str, trial: int) -> float:
        return float(curve(self.evaluations, name, self.measure)[trial])

    def _mean(self, name: str, first: int, last: int) -> float:
        return float(window(self.evaluations, name, self.measure, first, last).mean())

    def _spread(self, name: str) -> float:
        return float(spread(self.evaluations, name, self.measure).loc[3:].mean())

    def _label(self, name: str) -> str:
        return SCENARIOS[name].label

    def _reached(self, name: str, threshold: float) -> str:
        first = self._first(name, threshold)
        return f"{threshold:g} cm {'never' if first is None else f'at trial {first}'}"

    def _described(self, name: str) -> str:
        reached = f"{self._reached(name, 10)}, {self._reached(name, 8)}"
        end = f"at {LAST} {self._at(name, LAST):.1f} cm"
        return f"{reached}, {end} ({num_runs(self.evaluations, name)})"

    def _beside(self, name: str) -> str:
        present = self.evaluations[self.evaluations["scenario"] == name]
        if not (present["trial"] == LAST).any():
            return ""
        return f"; {self._label(name)}: {self._described(name)}"
