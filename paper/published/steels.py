"""Yield strengths of steels, most of them maraging: ten lines of metallurgy, and what they lack.

Rows and folds are Matbench's (Dunn et al. 2020, npj Computational Materials 6). Inputs of all
models are log(c + 0.001), c the mole fractions of thirteen elements; iron is the rest. Formula,
inputs and kernel were tried by five folds of the training rows of the first fold, on no test row.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import pandas as pd
import torch
from gpytorch.kernels import Kernel, MaternKernel, ScaleKernel
from torch import Tensor

from gpadjust import (
    CKA,
    CalibratedPhysics,
    FunctionPhysics,
    PhysicsMeanGP,
    Unknown,
    ZeroMeanGP,
    fit,
)
from gpadjust.core import GP, SamplingWarning
from gpadjust.physics import ParameterValues
from gpadjust.validation import score
from paper.common.experiment import Run, Table
from paper.common.tables import Cell, frame, groups, number, of, table, with_rows
from paper.common.verdicts import Difference
from paper.published import Steels
from paper.published.rivals import RIVALS

DATA = Path(__file__).parent / "data" / "steels" / "steels.csv"
ELEMENTS = ("Al", "C", "Co", "Cr", "Mn", "Mo", "N", "Nb", "Ni", "Si", "Ti", "V", "W")
TRACE = 0.001  # a mole fraction below which an element is a trace
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

    Lath martensite, a linear solid solution, carbon and nitrogen by the root of their share (more
    with what forms carbides), and particles of Ni3(Ti, Mo, Al) by the root of theirs; cobalt takes
    more molybdenum out of solution. Below its start temperature, linear in the elements (Andrews
    1965), martensite is what is not austenite.
    """
    c = dict(zip(ELEMENTS, X.exp().sub(TRACE).clamp_min(0).unbind(-1), strict=True))
    heavy = c["Mo"] + c["W"]
    start = 539 - 9000 * c["C"] - 3000 * c["Mn"] - 1800 * c["Ni"] - 1200 * (c["Cr"] + c["Mo"])
    martensite = ((start + 1000 * c["Co"] - p.finish) / 60).sigmoid()
    solution = heavy + c["V"] + 0.5 * c["Si"] + 0.3 * (c["Co"] + c["Ni"]) + 0.1 * c["Cr"]
    formers = c["Ti"] + p.aluminium * c["Al"] + p.molybdenum * heavy * (1 + p.cobalt * c["Co"])
    particles = c["Ni"] / (c["Ni"] + 0.05) * (formers + 1e-6).sqrt()
    carbon = (c["C"] + c["N"]).sqrt() * (1 + p.carbides * (heavy + c["V"]))
    hard = p.lath + p.carbon * carbon + p.particles * particles
    return martensite * hard + p.solution * solution


UNKNOWNS = {
    "finish": Unknown(50.0, sd=100.0, unit="°C"),
    "lath": Unknown(600.0, factor=1.5, unit="MPa"),
    "solution": Unknown(3000.0, factor=2.0, unit="MPa"),
    "carbon": Unknown(4000.0, factor=2.0, unit="MPa"),
    "carbides": Unknown(3.0, factor=3.0),
    "particles": Unknown(5000.0, factor=2.0, unit="MPa"),
    "aluminium": Unknown(0.5, factor=2.0),
    "molybdenum": Unknown(0.3, factor=3.0),
    "cobalt": Unknown(3.0, factor=2.0),
}


def kernel() -> Kernel:
    """Return the sum of a rough kernel, of what heats of one alloy share, and a smooth one."""
    rough, smooth = (MaternKernel(nu=nu, ard_num_dims=len(ELEMENTS)) for nu in (0.5, 2.5))
    return ScaleKernel(rough) + ScaleKernel(smooth)


MODELS: dict[str, Callable[..., GP]] = {
    "formula": CalibratedPhysics,
    "phymean": lambda X, Y, physics: PhysicsMeanGP(X, Y, physics=physics, covar_module=kernel()),
    "cka": lambda X, Y, physics: CKA(X, Y, physics=physics, delta_covar_module=kernel()),
    "gp": lambda X, Y, physics: ZeroMeanGP(X, Y, covar_module=kernel()),
}


def split(fold: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Inputs and outputs in MPa of the training rows of a fold, and of its test rows."""
    rows = pd.read_csv(DATA)
    out = torch.tensor((rows["test_fold"] == fold).tolist())
    X, Y = (
        torch.from_numpy(rows[columns].to_numpy(dtype=float, copy=True))
        for columns in ([*ELEMENTS], ["yield_strength_MPa"])
    )
    X = X.add(TRACE).log()
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
        model = MODELS[method](X, Y - shift, physics=physics)
        fit(model, seed=seed)
        predict = partial(model.posterior, observation_noise=True)
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
