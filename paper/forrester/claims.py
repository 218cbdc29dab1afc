"""The paper's claims about this experiment, each with the number that decides it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import pandas as pd

from paper.forrester.models import NAMES

Verdict = Literal["reproduced", "not reproduced", "beaten"]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, our verdict, and the measured number behind it."""

    id: str
    claim: str
    verdict: Verdict
    measured: str


def judge(runs: pd.DataFrame) -> list[Claim]:
    """Judge the claims on the runs of one reading and protocol.

    "About 30 %" is taken as 20 to 40 %, "about 50 %" as 40 to 60 %, "slightly" as within 20 %;
    beyond, in the claim's favour, a claim is beaten. Best is who is within two standard errors of
    the paired difference to the lowest mean.
    """
    by_model = runs.groupby("model")["rmse"]
    mean, sd = by_model.mean(), by_model.std()

    rmse = runs.pivot(index="seed", columns="model", values="rmse")

    def change(model: str, reference: str) -> float:
        return float(mean[model] / mean[reference] - 1)

    def described(model: str, reference: str) -> str:
        error = (rmse[model] - rmse[reference]).sem() / mean[reference]
        return f"{change(model, reference):+.1%} ± {error:.1%}"

    def slightly_below(model: str, reference: str) -> Verdict:
        below = -change(model, reference)
        return "not reproduced" if below <= 0 else "reproduced" if below <= 0.2 else "beaten"

    def below_by(model: str, low: float, high: float) -> Verdict:
        below = -change(model, "Phy-mean GP")
        return "not reproduced" if below < low else "reproduced" if below <= high else "beaten"

    gap = (rmse["GP-bias"] - rmse["Phy-mean GP"]).abs().max()
    wider = sd["GP-scale"] > sd["Zero-mean GP"]
    f2 = slightly_below("GP-scale", "Zero-mean GP")
    f4 = max(mean["Phy-mean GP"], mean["AR1"]) < mean["GP-scale"]
    f5 = sd["AR1"] > sd["Phy-mean GP"]
    best = mean[list(NAMES)].idxmin()
    behind = rmse["RRA"] - rmse[best]
    among_best = behind.mean() <= 2 * behind.sem()
    f7 = below_by("RRA", 0.4, 0.6) if best == "RRA" or among_best else "not reproduced"

    def yes(held: bool) -> Verdict:
        return "reproduced" if held else "not reproduced"

    return [
        Claim(
            "F1",
            "zero-mean GP slightly below f_p",
            slightly_below("Zero-mean GP", "f_p"),
            f"{described('Zero-mean GP', 'f_p')} of f_p's RMSE",
        ),
        Claim(
            "F2",
            "GP-scale slightly below zero-mean GP, with the larger spread",
            f2 if wider else "not reproduced",
            f"{described('GP-scale', 'Zero-mean GP')}, sd {sd['GP-scale']:.3g} "
            f"against {sd['Zero-mean GP']:.3g}",
        ),
        Claim(
            "F3",
            "Phy-mean GP and GP-bias are the same model",
            yes(gap <= 1e-9),
            f"RMSEs differ by {gap:.1g} at most",
        ),
        Claim(
            "F4",
            "Phy-mean GP and AR1 below GP-scale",
            yes(f4),
            f"{mean['Phy-mean GP']:.3g} and {mean['AR1']:.3g} against {mean['GP-scale']:.3g}",
        ),
        Claim(
            "F5",
            "AR1 has the largest spread of Phy-mean GP, GP-bias and AR1",
            yes(f5),
            f"sd {sd['AR1']:.3g} against {sd['Phy-mean GP']:.3g}",
        ),
        Claim(
            "F6",
            "CKA about 30 % below Phy-mean GP",
            below_by("CKA", 0.2, 0.4),
            described("CKA", "Phy-mean GP"),
        ),
        Claim(
            "F7",
            "RRA about 50 % below Phy-mean GP, the best",
            f7,
            f"{described('RRA', 'Phy-mean GP')}; the best is {best}"
            + (", within 2 standard errors" if best != "RRA" and among_best else ""),
        ),
    ]
