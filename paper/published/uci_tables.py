"""Three tables of the UCI repository, their usual splits, and a formula for each.

The forms of the formulas and the priors were chosen by looking at whole tables; parameters are
fitted to the training rows of each split alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import FunctionPhysics, Unknown
from gpadjust.physics import ParameterValues

DATA = Path(__file__).parent / "data" / "uci"
_OUTPUTS = {"yacht": "residuary_resistance", "energy": "heating_load", "concrete": "strength"}


def resistance(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the wave resistance of a yacht by its Froude number.

    The exponential of Holtrop and Mennen (1982, An approximate power prediction method,
    International Shipbuilding Progress 29), without the term of interference and with one pair of
    coefficients for all hulls.
    """
    power = X[:, 5] ** -0.9
    return p.resistance * (p.exponent * (power - 0.35**-0.9)).exp()


def heating(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the heat that a building loses, U A times one difference of temperature.

    Through walls, glass and roof, and by the air of its floors. A floor is as large as the roof and
    3.5 m high, and glazing is a share of the floors (the description of the data).
    """
    wall, roof, height, glazing = (X[:, i] for i in (2, 3, 4, 6))
    floors = roof * height / 3.5
    glass = glazing * floors
    return p.air * floors + p.wall * (wall - glass) + p.glass * glass + p.roof * roof


def strength(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the compressive strength of concrete by its water and its age.

    Abrams's law (1918), a b^-(water / binder), in which slag and ash count for a share of cement
    (the k-values of EN 206), and growth with the logarithm of the age in units of 28 days.
    """
    cement, slag, ash, water, *_, age = X.unbind(-1)
    binder = cement + p.slag * slag + p.ash * ash
    return p.scale * p.base ** (-water / binder) * (1 + p.growth * (age / 28).log())


FORMULAS: Mapping[str, tuple[Callable[[Tensor, ParameterValues], Tensor], Mapping[str, Unknown]]]
FORMULAS = {
    "yacht": (
        resistance,
        {"resistance": Unknown(5.0, factor=3.0), "exponent": Unknown(-3.0, sd=3.0)},
    ),
    "energy": (
        heating,
        {
            "air": Unknown(0.05, sd=0.1),
            "wall": Unknown(0.05, sd=0.1),
            "glass": Unknown(0.2, sd=0.2),
            "roof": Unknown(0.05, sd=0.1),
        },
    ),
    "concrete": (
        strength,
        {
            "scale": Unknown(100.0, factor=2.0, unit="MPa"),
            "base": Unknown(7.0, factor=2.0),
            "slag": Unknown(0.7, sd=0.3, bounds=(0.0, 2.0)),
            "ash": Unknown(0.4, sd=0.2, bounds=(0.0, 2.0)),
            "growth": Unknown(0.25, sd=0.1),
        },
    ),
}
"""The formula of each table, and the priors of its parameters."""


class Split(NamedTuple):
    """Training and test rows of a table, ``n x d`` and ``n x 1``."""

    X: Tensor
    Y: Tensor
    points: Tensor
    expected: Tensor


@cache
def _read(table: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = pd.read_csv(DATA / f"{table}.csv")
    test = pd.read_csv(DATA / f"{table}_test.csv").to_numpy() == 1
    output = _OUTPUTS[table]
    return rows.drop(columns=output).to_numpy(float), rows[[output]].to_numpy(float), test


def split(table: str, share: float, number: int) -> Split:
    """Return one of the twenty usual splits, with some of its training rows.

    Args:
        table: Which.
        share: Of all rows, for training: 0.9 for all training rows of the split; of fewer those
            that the number of the split draws.
        number: Of the split, 0 to 19.
    """
    X, Y, test = _read(table)
    train = np.flatnonzero(~test[:, number])
    if share < 0.9:
        train = np.random.default_rng(number).permutation(train)[: round(share * len(X))]
    at = test[:, number]
    return Split(*(torch.from_numpy(each) for each in (X[train], Y[train], X[at], Y[at])))


def physics(table: str) -> FunctionPhysics:
    """Return the formula of a table, with unknown parameters."""
    law, unknowns = FORMULAS[table]
    return FunctionPhysics(law, unknowns=unknowns)
