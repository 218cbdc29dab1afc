"""NIST's reference data of nonlinear regression: certified values, and draws of the posterior.

Each parameter is one of NIST's two starts times an unknown factor, which is log-normal around 1 by
a factor of 10: the same rule for all sets, fixed before the first run.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CalibratedPhysics, Unknown
from gpadjust.physics import FormulaPhysics
from paper.common.experiment import Run, Table, fitted
from paper.common.tables import Cell, groups, markdown, of, table
from paper.published import Nist

DATA = Path(__file__).parent / "data" / "nist"
FACTOR = 10.0  # one standard deviation of the prior
WIDE = 1.5  # factor between widths of intervals that counts as the same
_PEAKS = "b1*exp(-b2*x) + b3*exp(-(x - b4)**2/b5**2) + b6*exp(-(x - b7)**2/b8**2)"
_CUBICS = "(b1 + b2*x + b3*x**2 + b4*x**3)/(1 + b5*x + b6*x**2 + b7*x**3)"
_THREE = "b1*exp(-b2*x) + b3*exp(-b4*x) + b5*exp(-b6*x)"
_WAVES = (
    "b1 + b2*cos(2*pi*x/12) + b3*sin(2*pi*x/12) + b5*cos(2*pi*x/b4) + b6*sin(2*pi*x/b4)"
    " + b8*cos(2*pi*x/b7) + b9*sin(2*pi*x/b7)"
)
FORMULAS = {
    "Misra1a": "b1*(1 - exp(-b2*x))",
    "Chwirut2": "exp(-b1*x)/(b2 + b3*x)",
    "Chwirut1": "exp(-b1*x)/(b2 + b3*x)",
    "Lanczos3": _THREE,
    "Gauss1": _PEAKS,
    "Gauss2": _PEAKS,
    "DanWood": "b1*x**b2",
    "Misra1b": "b1*(1 - (1 + b2*x/2)**(-2))",
    "Kirby2": "(b1 + b2*x + b3*x**2)/(1 + b4*x + b5*x**2)",
    "Hahn1": _CUBICS,
    "Nelson": "b1 - b2*x*exp(-b3*x2)",
    "MGH17": "b1 + b2*exp(-x*b4) + b3*exp(-x*b5)",
    "Lanczos1": _THREE,
    "Lanczos2": _THREE,
    "Gauss3": _PEAKS,
    "Misra1c": "b1*(1 - (1 + 2*b2*x)**(-0.5))",
    "Misra1d": "b1*b2*x/(1 + b2*x)",
    "Roszman1": "b1 - b2*x - atan(b3/(x - b4))/pi",
    "ENSO": _WAVES,
    "MGH09": "b1*(x**2 + x*b2)/(x**2 + x*b3 + b4)",
    "Thurber": _CUBICS,
    "BoxBOD": "b1*(1 - exp(-b2*x))",
    "Rat42": "b1/(1 + exp(b2 - b3*x))",
    "MGH10": "b1*exp(b2/(x + b3))",
    "Eckerle4": "b1/b2*exp(-0.5*((x - b3)/b2)**2)",
    "Rat43": "b1/(1 + exp(b2 - b3*x))**(1/b4)",
    "Bennett5": "b1*(b2 + x)**(-1/b3)",
}
"""The models, in NIST's order of difficulty; of Nelson that of the logarithm of y."""


class Reference(NamedTuple):
    """A data set with the certified result."""

    X: Tensor  # n x d
    Y: Tensor  # n x 1
    starts: Tensor  # 2 x p
    value: Tensor  # p
    sd: Tensor  # p, of the least-squares estimate


@cache
def reference(name: str) -> Reference:
    """Read a data set."""
    text = (DATA / f"{name}.dat").read_text()
    head, _, data = text.rpartition("Data:")
    rows = re.findall(r"^ +b\d+ =(.*)$", head, re.MULTILINE)
    numbers = torch.tensor([[*map(float, row.split())] for row in rows], dtype=torch.float64)
    table = torch.from_numpy(np.loadtxt(data.splitlines()[1:]))
    Y = table[:, :1].log() if name == "Nelson" else table[:, :1]
    return Reference(table[:, 1:], Y, numbers[:, :2].T, numbers[:, 2], numbers[:, 3])


def model_of(name: str, start: int) -> CalibratedPhysics:
    """Make the model, whose unknown parameters are factors of a start, 1 or 2."""
    data = reference(name)
    begin = data.starts[start - 1].tolist()
    formula = re.sub(r"\bb(\d)\b", lambda b: f"({begin[int(b[1]) - 1]!r}*b{b[1]})", FORMULAS[name])
    unknowns = {f"b{i + 1}": Unknown(1.0, factor=FACTOR) for i in range(len(begin))}
    physics = FormulaPhysics(formula, ["x", "x2"][: data.X.shape[-1]], unknowns=unknowns)
    return CalibratedPhysics(data.X, data.Y, physics=physics)


def run(experiment: Nist, name: str, start: int, seed: int) -> Run:
    """Fit a set; return means and half widths of 95 % intervals of the parameters."""
    data, model = reference(name), model_of(name, start)
    seconds = fitted(model, seed=seed)
    found, factor = model.physics_parameters, data.starts[start - 1]
    low, high = (end * factor for end in found.interval())
    return {
        "mean": (found.mean * factor).tolist(),
        "half": ((high - low) / 2).abs().tolist(),
        "seconds": seconds,
    }


def tables(runs: Sequence[Run], experiment: Nist) -> dict[str, Table]:
    """Return all tables, by name."""
    columns: dict[str, Cell] = {
        "rows": of("rows", "max", ".0f"),
        "parameters": of("parameters", "max", ".0f"),
        "farthest value, start 1": of("off", "max", ".2g", start=1),
        "farthest value, start 2": of("off", "max", ".2g", start=2),
        "widths": lambda part: f"{part['least'].min():.2g} to {part['most'].max():.2g}",
        "within both": lambda part: "yes" if _within_both(part) else "no",
        "seconds": of("seconds", "mean", ".1f"),
    }
    parts = groups(load(runs), "name", experiment.axes["name"])
    good = sum(map(_within_both, parts.values()))
    summary = [["sets", f"{len(parts)}"], ["within both limits", f"{good}"]]
    title = "Distance from the certified values and widths, in standard errors"
    return {
        "sets": Table(title, table(parts, columns, "set")),
        "summary": Table("How many sets", markdown(["", "number"], summary)),
    }


def _within_both(part: pd.DataFrame) -> bool:
    widths = part["least"].min() > 1 / WIDE and part["most"].max() < WIDE
    return bool(part["off"].max() < 1 and widths)


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """Return the farthest value of each run and its extreme intervals, in standard errors."""
    rows = []
    for run in runs:
        data = reference(run["name"])
        off = ((torch.tensor(run["mean"]) - data.value) / data.sd).abs().max().item()
        width = torch.tensor(run["half"]) / 1.96 / data.sd
        row = {"rows": len(data.X), "parameters": len(data.value), "off": off}
        row |= {"least": width.min().item(), "most": width.max().item()}
        rows.append(row | {key: run[key] for key in ("name", "start", "seconds")})
    return pd.DataFrame(rows)
