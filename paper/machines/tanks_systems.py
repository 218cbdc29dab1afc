"""Two tanks below each other, and what was measured of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gpadjust.dynamics import StateSpec
from gpadjust.physics import ODEPhysics, Unknown
from gpadjust.records import Record, Records
from paper.machines.records import DATA

STEP = 4.0  # s
FULL = 10.0  # V, beyond which the sensor says no more
SPEC = StateSpec(["upper", "lower"], ["pump"])
START = {"upper": (5.0, 2.0)}

UNKNOWNS = {
    "upper_outflow": Unknown(0.04, factor=2.0),
    "lower_outflow": Unknown(0.04, factor=2.0),
    "pump": Unknown(0.04, factor=2.0),
    "offset": Unknown(0.0, sd=0.05),
    "brim": Unknown(9.0, factor=1.5),
    "share": Unknown(0.5, factor=2.0),
    "empty": Unknown(2.2, sd=0.3, bounds=(-math.inf, 2.8)),
    "power": Unknown(0.6, factor=1.5),
    "kink": Unknown(0.0, sd=0.3),
    "place": Unknown(5.3, sd=0.5),
    "width": Unknown(0.5, factor=1.65),
}
"""Priors of the parameters, levels in V.

Of the upper tank its brim, and the share of its overflow that the lower tank gets; of the sensor
what it says of an empty tank, and its form.
"""

_STRAIGHT = {"kink": 0.0, "place": 5.3, "width": 0.5}
FIXED: dict[str, dict[str, float]] = {
    "overflow": {"empty": 0.0, "power": 1.0, **_STRAIGHT},
    "kink": {},
}
"""The parameters that a structure has for known."""

_OVERFLOW = (1.5, 1.0)  # 1/s, by which the tanks flow over
_BRIM = 10.1  # V, of the lower tank


def rates(state: Tensor, action: Tensor, p: Mapping[str, Any]) -> Tensor:
    r"""Return the rates of the levels in V/s: Torricelli's outflow, and overflow.

    The sensor says y of the lower level :math:`h = 5 s^r - d \tanh((y - c) / w)` with
    :math:`s = (y - e) / (5 - e)`, in a unit in which both are 5 near the middle.
    """
    upper, y = state.unbind(-1)
    s = ((y - p["empty"]) / (5 - p["empty"])).clamp_min(0.02)
    bend = torch.tanh((y - p["place"]) / p["width"])
    level = (5 * s ** p["power"] - p["kink"] * bend).clamp_min(1e-4)
    slope = 5 * p["power"] / (5 - p["empty"]) * s ** (p["power"] - 1)
    slope = (slope - p["kink"] / p["width"] * (1 - bend**2)).clamp_min(0.1)
    outflow = p["upper_outflow"] * upper.clamp_min(1e-4).sqrt()
    over = _OVERFLOW[0] * (upper - p["brim"]).clamp_min(0)
    inflow = (p["pump"] * action[:, 0] + p["offset"]).clamp_min(0)
    gained = outflow + p["share"] * over - p["lower_outflow"] * level.sqrt()
    lost = _OVERFLOW[1] * (y - _BRIM).clamp_min(0)
    return torch.stack([inflow - outflow - over, gained / slope - lost], dim=-1)


def physics(structure: str, values: Mapping[str, float] | None = None) -> ODEPhysics:
    """Return the physics of the next levels, with unknown parameters, or these."""
    fixed: dict[str, Any] = {**FIXED[structure], **(values or {})}
    unknowns = {name: known for name, known in UNKNOWNS.items() if name not in fixed}
    options: dict[str, Any] = {"step": STEP, "state_dim": 2, "substeps": 4}
    if not unknowns:
        return ODEPhysics(lambda x, u: rates(x, u, fixed), name=structure, **options)
    return ODEPhysics(
        lambda x, u, p: rates(x, u, {**fixed, **p}), unknowns=unknowns, name=structure, **options
    )


def measured(part: str, samples: int) -> tuple[Tensor, Tensor]:
    """Return actions and levels of a record, ``samples`` each; of ``"Est"`` or ``"Val"``."""
    spec = StateSpec(["lower"], ["pump"])
    columns: dict[str, Any] = {"states": {"lower": f"y{part}"}, "actions": {"pump": f"u{part}"}}
    file = DATA / "tanks" / "dataBenchmark.csv"
    (record,) = Records.read_csv(file, spec, **columns, time=STEP)
    return record.actions[:samples, 0], record.states[:samples, 0]


def levels(actions: Tensor, lower: Tensor) -> Records:
    """Return a record of both tanks; the upper level and a full sensor's values are hidden."""
    lower = lower.where(lower < FULL - 0.01, torch.nan)
    states = torch.stack([torch.full_like(lower, torch.nan), lower], dim=-1)
    times = STEP * torch.arange(len(lower), dtype=torch.float64)
    return Records([Record(times, states, actions.unsqueeze(-1), name="tanks")], SPEC)


def outputs(actions: Tensor, lower: Tensor) -> Records:
    """Return a record of the lower tank alone, with the level and action before."""
    previous = {"lower_1": "lower", "pump_1": "pump"}
    spec = StateSpec(["lower", *previous], ["pump"], previous=previous)
    states = torch.full((len(lower), spec.state_dim), torch.nan, dtype=torch.float64)
    states[:, 0] = lower
    times = STEP * torch.arange(len(lower), dtype=torch.float64)
    return Records([Record(times, states, actions.unsqueeze(-1), name="tanks")], spec)
