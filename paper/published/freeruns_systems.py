"""Four records, and a line of physics for each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import torch
from torch import Tensor

from gpadjust import FunctionPhysics, Unknown
from gpadjust.dynamics import StateSpec
from gpadjust.physics import ParameterValues
from gpadjust.records import Record, Records
from paper.common.free_runs import law_of

DATA = Path(__file__).parent / "data" / "records"


class System(NamedTuple):
    """A record, its parts, and a line of physics for it."""

    file: str  # its name
    action: str  # column of the action
    output: str  # column of the output
    train: int  # rows of the first part, as in PR-SSM's code; of the tanks as in RGP's
    states: tuple[str, ...]  # states of f_p, that of the output first; the others are hidden
    # Next states from these and the action, by the parameters.
    following: Callable[[Tensor, ParameterValues], Tensor]
    unknowns: Mapping[str, Unknown]  # these, with priors
    # Of hidden states, mean and standard deviation at first.
    start: Mapping[str, tuple[float, float]]
    noise: tuple[float, ...] | None  # process noise; None if it is learnt
    narx: tuple[int, int]  # how many outputs and actions a GP without f_p reads
    delay: int = 0  # steps by which the action is late
    earlier: int = 0  # how many earlier actions a GP that adjusts f_p reads

    def physics(self, values: list[float] | None = None) -> FunctionPhysics:
        """Return the physics of the next states, with unknown parameters or these."""
        return law_of(self.following, self.unknowns, values)

    def spec(self, earlier: int = 0) -> StateSpec:
        """Return the spec, with so many earlier actions, or as many as f_p reads."""
        lags = _previous("u", max(earlier, self.delay))
        last = f"u_{self.delay}" if self.delay else "u"
        names = [*self.states, *lags]
        return StateSpec(names, ["u"], previous=lags, physics_reads=[*self.states, last])

    def column(self, name: str) -> Tensor:
        """Return a column of the record."""
        return torch.from_numpy(pd.read_csv(DATA / self.file)[name].to_numpy(float, copy=True))


def _previous(name: str, lags: int) -> dict[str, str]:
    return {f"{name}_{k}": f"{name}_{k - 1}" if k > 1 else name for k in range(1, lags + 1)}


def narx_spec(outputs: int, actions: int) -> StateSpec:
    """Return the spec of so many values of output and action, the newest included."""
    previous = {**_previous("y", outputs - 1), **_previous("u", actions - 1)}
    return StateSpec(["y", *previous], ["u"], previous=previous)


def records(states: Tensor, actions: Tensor, spec: StateSpec) -> Records:
    """Return a record whose first states are these; the rest is hidden, or filled in."""
    whole = torch.full((len(states), spec.state_dim), torch.nan, dtype=torch.float64)
    whole[:, : states.shape[1]] = states
    times = torch.arange(len(states), dtype=torch.float64)
    return Records([Record(times, whole, actions.unsqueeze(-1))], spec)


def _loop(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the next state of a ball held by a controller, u = -gain y, of a delayed place."""
    y, v, u = X.unbind(-1)
    pull = p.frequency**2 * (-u / p.gain - y) - 2 * p.damping * p.frequency * v
    faster = v + 0.1 * pull
    return torch.stack([y + 0.05 * (v + faster), faster], dim=-1)


def _two_lags(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the next state of two mixed vessels, one after the other."""
    y, mixed, u = X.unbind(-1)
    first, second = (1 - torch.exp(-1 / lag) for lag in (p.lag, p.lag_before))
    return torch.stack(
        [y + first * (p.base - p.gain * mixed - y), mixed + second * (u - mixed)], dim=-1
    )


def _belt(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the next state of a pulley on an elastic belt behind motors that lag."""
    _, speed, rate, motor, u = X.unbind(-1)
    for _ in range(4):
        motor = motor + 0.25 * (u - motor) / p.lag
        pull = p.frequency**2 * (p.gain * motor + p.offset - speed)
        rate = rate + 0.25 * (pull - 2 * p.damping * p.frequency * rate)
        speed = speed + 0.25 * rate
    return torch.stack([speed.abs(), speed, rate, motor], dim=-1)


def _tanks(X: Tensor, p: ParameterValues) -> Tensor:
    """Return the next levels of two equal tanks by Torricelli; inflow is a power of the voltage."""
    lower, upper, u = X.unbind(-1)
    inflow = p.pump * u.clamp_min(1e-3) ** p.power
    for _ in range(2):
        between = p.upper_outflow * upper.clamp_min(1e-3).sqrt()
        out = p.lower_outflow * lower.clamp_min(1e-3).sqrt()
        upper, lower = upper + 0.5 * (inflow - between), lower + 0.5 * (between - out)
    return torch.stack([lower, upper], dim=-1)


_VESSELS = {
    "base": Unknown(53.0, sd=3.0),
    "gain": Unknown(1.0, factor=2.0),
    "lag": Unknown(2.0, factor=2.0),
    "lag_before": Unknown(1.0, factor=2.0),
}
_PULLEY = {
    "gain": Unknown(1.5, factor=1.5),
    "offset": Unknown(0.0, sd=0.3),
    "frequency": Unknown(0.5, factor=1.7),
    "damping": Unknown(0.2, factor=2.0),
    "lag": Unknown(3.0, factor=2.0),
}
_FLOWS = {name: Unknown(0.1, factor=2.0) for name in ("pump", "upper_outflow", "lower_outflow")}
_BALL = {
    "gain": Unknown(0.3, factor=3.0),
    "frequency": Unknown(1.0, factor=3.0),
    "damping": Unknown(0.7, factor=2.0),
}

SYSTEMS = {
    "ballbeam": System(
        *("ballbeam.csv", "u", "y", 500, ("y", "v"), _loop, _BALL, {"v": (0.0, 0.05)}),
        noise=(1e-3, 1e-2), narx=(2, 20), earlier=20,
    ),
    "furnace": System(
        *("gas_furnace.csv", "gas_rate", "co2", 148, ("y", "mixed"), _two_lags, _VESSELS),
        {"mixed": (0.0, 1.0)}, noise=None, narx=(2, 5), delay=1, earlier=3,
    ),
    "drive": System(
        *("drive.csv", "u1", "z1", 250, ("y", "speed", "rate", "motor"), _belt, _PULLEY),
        {"speed": (0.0, 0.1), "rate": (0.0, 0.1), "motor": (0.0, 1.0)},
        noise=(0.01, 0.1, 0.1, 0.01), narx=(10, 10),
    ),
    "tanks": System(
        *("two_tanks.csv", "u", "y1", 1250, ("y", "upper"), _tanks),
        {**_FLOWS, "power": Unknown(1.0, factor=1.5)}, {"upper": (1.0, 1.0)},
        noise=(0.01, 0.01), narx=(3, 1),
    ),
}  # fmt: skip
"""By the names of the records; chosen by folds of their first parts, in an earlier experiment."""
