"""Yield strengths of steels, most of them maraging: ten lines of metallurgy, and what they lack.

Rows and folds are Matbench's (Dunn et al. 2020, npj Computational Materials 6). Inputs of all
models are log(c + 0.001), c the mole fractions of thirteen elements; iron is the rest. Formula,
inputs and kernel were tried by five folds of the training rows of the first fold, on no test row.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch
from gpytorch.kernels import Kernel, MaternKernel, ScaleKernel
from torch import Tensor

from gpadjust import FunctionPhysics, Unknown
from gpadjust.physics import ParameterValues
from paper.common.experiment import Run, Table
from paper.common.tables import Cell, frame, groups, mean_error, of, table
from paper.published import Steels, published
from paper.published.rivals import RIVALS, judged, ours

DATA = Path(__file__).parent / "data" / "steels" / "steels.csv"
ELEMENTS = ("Al", "C", "Co", "Cr", "Mn", "Mo", "N", "Nb", "Ni", "Si", "Ti", "V", "W")
TRACE = 0.001  # a mole fraction below which an element is a trace


def strength(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the yield strength in MPa.

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


KERNELS = {
    "formula": (),
    "phymean": ("covar_module",),
    "cka": ("delta_covar_module",),
    "gp": ("covar_module",),
}
"""Arguments of each model that are the kernel above."""


def split(fold: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return inputs and outputs in MPa of the training rows of a fold, and of its test rows."""
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
    fitted = RIVALS.get(method) or ours(method, **{name: kernel() for name in KERNELS[method]})
    physics = FunctionPhysics(strength, unknowns=UNKNOWNS)
    return judged(fitted, split(seed), physics, seed=seed, is_centred=method == "gp")


def tables(runs: Sequence[Run], experiment: Steels) -> dict[str, Table]:
    """Return mean absolute errors over the folds, and published ones."""
    columns: dict[str, Cell] = {
        "mean absolute error, MPa": mean_error("mae", ".1f"),
        "folds": len,
        "worst fold, MPa": of("mae", "max", ".1f"),
        "RMSE, MPa": of("rmse", "mean", ".1f"),
        "95 % coverage": of("coverage", "mean", ".3f"),
        "seconds of a fit": of("seconds", "median", ".0f"),
    }
    rows = groups(frame(runs), "method", experiment.axes["method"])
    more = [[f"{name}, published", *error] for name, error in published("steels").items()]
    text = table(rows, columns, "method", more)
    return {"errors": Table("312 steels, five fixed folds", text)}
