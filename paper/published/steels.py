"""Yield strengths of steels, most of them maraging: ten lines of metallurgy, and what they lack.

Rows and folds are Matbench's (Dunn et al. 2020, npj Computational Materials 6). Inputs of all
models are the mole fractions of thirteen elements; iron is the rest. The form of the formula was
tried on training rows of the first fold, and on no test row.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from gpadjust import FunctionPhysics, Unknown
from gpadjust.core import SamplingWarning
from gpadjust.physics import ParameterValues
from gpadjust.validation import score
from paper.common.experiment import Run, Table
from paper.common.tables import Cell, frame, groups, number, of, table, with_rows
from paper.common.verdicts import Difference
from paper.published import Steels
from paper.published.rivals import RIVALS
from paper.published.uci import ours

DATA = Path(__file__).parent / "data" / "steels" / "steels.csv"
ELEMENTS = ("Al", "C", "Co", "Cr", "Mn", "Mo", "N", "Nb", "Ni", "Si", "Ti", "V", "W")
PUBLISHED = {
    "AutoML-Mat": 82.3,
    "TPOT-Mat": 79.9,
    "MODNet": 87.8,
    "random forest": 103.5,
    "CrabNet": 107.3,
    "mean of the training rows": 229.7,
}
"""Mean absolute errors in MPa over the five folds, of the leaderboard of Matbench (936176d)."""


def strength(X: Tensor, p: ParameterValues) -> Tensor:
    """Yield strength in MPa.

    Lath martensite, solid solution by c^(2/3) (Fleischer, Labusch), carbon by its root, and
    particles of Ni3(Ti, Mo, Al) by the root of their share, of which cobalt takes more molybdenum
    out of solution. Below its start temperature, linear in the elements (Andrews 1965), martensite
    is what is not austenite.
    """
    c = dict(zip(ELEMENTS, X.unbind(-1), strict=True))
    start = 539 - 9000 * c["C"] - 3000 * c["Mn"] - 1800 * c["Ni"] - 1200 * c["Cr"] - 1200 * c["Mo"]
    martensite = ((start + 1000 * c["Co"] - p.finish) / 60).sigmoid()
    dissolved = sum(c[e] ** (2 / 3) for e in ("Cr", "Ni", "Mo", "Mn", "Si", "Co", "W", "V"))
    formers = c["Ti"] + c["Al"] * p.aluminium + c["Mo"] * p.molybdenum * (1 + p.cobalt * c["Co"])
    particles = torch.minimum(formers, c["Ni"] / 3)
    carbon = c["C"] + c["N"]
    hard = p.lath + p.carbon * carbon.sqrt() + p.particles * (particles + 1e-6).sqrt()
    return martensite * hard + p.solution * dissolved


UNKNOWNS = {
    "finish": Unknown(50.0, sd=100.0, unit="°C"),
    "lath": Unknown(500.0, factor=1.5, unit="MPa"),
    "solution": Unknown(300.0, factor=2.0, unit="MPa"),
    "carbon": Unknown(3000.0, factor=2.0, unit="MPa"),
    "particles": Unknown(4000.0, factor=2.0, unit="MPa"),
    "aluminium": Unknown(0.5, factor=2.0),
    "molybdenum": Unknown(0.5, factor=2.0),
    "cobalt": Unknown(3.0, factor=2.0),
}


def split(fold: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Inputs and outputs in MPa of the training rows of a fold, and of its test rows."""
    rows = pd.read_csv(DATA)
    out = torch.tensor((rows["test_fold"] == fold).tolist())
    X, Y = (
        torch.from_numpy(rows[columns].to_numpy(dtype=float, copy=True))
        for columns in ([*ELEMENTS], ["yield_strength_MPa"])
    )
    return X[~out], Y[~out], X[out], Y[out]


def run(experiment: Steels, method: str, seed: int) -> Run:
    """Fit a method to the training rows of a fold; return its scores on the test rows."""
    warnings.simplefilter("ignore", SamplingWarning)
    X, Y, test_X, test_Y = split(seed)
    physics = FunctionPhysics(strength, unknowns=UNKNOWNS)
    shift = Y.mean() if method == "gp" else torch.zeros(())
    begin = time.perf_counter()
    if method in RIVALS:
        predict = RIVALS[method](X, Y, physics, seed=seed)
    else:
        predict = ours(method, X, Y - shift, physics, seed=seed)
    seconds = time.perf_counter() - begin
    with torch.no_grad():
        posterior = predict(test_X)
        scores = score(posterior, test_Y - shift)
    error = posterior.mean.reshape(-1, 1) - (test_Y - shift)
    return {
        "mae": error.abs().mean().item(),
        "rmse": scores.rmse.item(),
        "density": -scores.nlpd.item(),
        "coverage": scores.coverage.item(),
        "seconds": seconds,
    }


def tables(runs: Sequence[Run], experiment: Steels) -> dict[str, Table]:
    """Mean absolute errors over the folds, beside published ones."""

    def over_folds(part: pd.DataFrame) -> str:
        found = Difference.of(part["mae"])
        return f"{found.mean:.1f} ± {found.error:.1f}"

    columns: dict[str, Cell] = {
        "mean absolute error, MPa": over_folds,
        "folds": len,
        "worst fold, MPa": lambda part: number(part["mae"].max(), ".1f"),
        "RMSE, MPa": of("rmse", "mean", ".1f"),
        "95 % hold": of("coverage", "mean", ".3f"),
        "seconds of a fit": of("seconds", "median", ".0f"),
    }
    rows = groups(frame(runs), "method", experiment.axes["method"])
    text = table(rows, columns, "method")
    published = sorted(PUBLISHED.items(), key=lambda pair: pair[1])
    text = with_rows(text, [[f"{name}, published", f"{error}"] for name, error in published])
    return {"errors": Table("312 steels, five fixed folds", text)}
