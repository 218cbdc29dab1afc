"""Four records, and the candidates for a line of physics of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from gpadjust import FunctionPhysics, Unknown
from gpadjust.dynamics import StateSpec
from gpadjust.physics import ParameterValues
from gpadjust.records import Record, Records

DATA = Path(__file__).parent / "data" / "records"
_G = 9.81  # m/s²


class Structure(NamedTuple):
    """A candidate for f_p.

    Args:
        states: Its states, that of the output first; the others are hidden.
        following: Next states from these and the action, by the parameters.
        unknowns: These, with priors.
        start: Of hidden states, mean and standard deviation at first.
        noises: Process noise to try, by a name each; None is learnt.
        delay: Steps by which the action is late.
    """

    states: tuple[str, ...]
    following: Callable[[Tensor, ParameterValues], Tensor]
    unknowns: Mapping[str, Unknown]
    start: Mapping[str, tuple[float, float]]
    noises: Mapping[str, tuple[float, ...] | None]
    delay: int = 0

    def physics(self, values: list[float] | None = None) -> FunctionPhysics:
        """The next states, with unknown parameters or these."""
        if values is None:
            return FunctionPhysics(self.following, unknowns=self.unknowns)
        known = ParameterValues(tuple(self.unknowns), torch.tensor(values, dtype=torch.float64))
        return FunctionPhysics(lambda X: self.following(X, known))

    def spec(self, earlier: int = 0) -> StateSpec:
        """States and actions, with so many earlier actions, or as many as f_p reads."""
        lags = _previous("u", max(earlier, self.delay))
        last = f"u_{self.delay}" if self.delay else "u"
        names = [*self.states, *lags]
        return StateSpec(names, ["u"], previous=lags, physics_reads=[*self.states, last])


class System(NamedTuple):
    """A record, its parts, and what is tried on the first of them.

    Args:
        file: Its name.
        action: Column of the action.
        output: Column of the output.
        train: Rows of the first part, as in PR-SSM's code; of the tanks as in RGP's.
        unit: Of the output.
        structures: Candidates for f_p, by name.
        earlier: Numbers of earlier actions that a GP beside f_p may read.
        narx: Numbers of outputs and actions that a GP without f_p may read.
        hidden: Column of a hidden state, which is never learnt from, with its name.
        after: Structures that were thought of after the test part had been seen; none is chosen.
    """

    file: str
    action: str
    output: str
    train: int
    unit: str
    structures: Mapping[str, Structure]
    earlier: tuple[int, ...]
    narx: tuple[tuple[int, int], ...]
    hidden: tuple[str, str] | None = None
    after: Mapping[str, Structure] = MappingProxyType({})

    def structure(self, name: str) -> Structure:
        """A candidate, or one that was thought of later."""
        return {**self.structures, **self.after}[name]

    def column(self, name: str) -> Tensor:
        """A column of the record."""
        return torch.from_numpy(pd.read_csv(DATA / self.file)[name].to_numpy(float, copy=True))

    def folds(self) -> list[tuple[int, int]]:
        """Rows that teach, and rows to the end of the free run that follows, in the first part."""
        quarter = self.train // 4
        return [(2 * quarter, 3 * quarter), (3 * quarter, 4 * quarter)]

    def describe(self) -> dict[str, Any]:
        """What is tried, in plain values."""
        tried = {
            name: {
                "priors": {k: u.prior_text for k, u in each.unknowns.items()},
                "noises": dict(each.noises),
                "delay": each.delay,
            }
            for name, each in self.structures.items()
        }
        return {"train": self.train, "structures": tried, "earlier": self.earlier,
                "narx": self.narx}  # fmt: skip


def _previous(name: str, lags: int) -> dict[str, str]:
    return {f"{name}_{k}": f"{name}_{k - 1}" if k > 1 else name for k in range(1, lags + 1)}


def narx_spec(outputs: int, actions: int) -> StateSpec:
    """The output with so many values of output and action, the newest included."""
    previous = {**_previous("y", outputs - 1), **_previous("u", actions - 1)}
    return StateSpec(["y", *previous], ["u"], previous=previous)


def records(states: Tensor, actions: Tensor, spec: StateSpec) -> Records:
    """A record whose first states are these; the rest is hidden, or filled in."""
    whole = torch.full((len(states), spec.state_dim), torch.nan, dtype=torch.float64)
    whole[:, : states.shape[1]] = states
    times = torch.arange(len(states), dtype=torch.float64)
    return Records([Record(times, whole, actions.unsqueeze(-1))], spec)


def _ball(X: Tensor, p: ParameterValues) -> Tensor:
    """A rolling ball: 5/7 g sin(angle), with a gain of its own, and viscous friction."""
    y, v, u = X.unbind(-1)
    faster = v + 0.1 * (p.gain * _G * u.sin() - p.friction * v)
    return torch.stack([y + 0.05 * (v + faster), faster], dim=-1)


def _loop(X: Tensor, p: ParameterValues) -> Tensor:
    """A ball that a controller holds: the angle is against its place, u = -gain y, of late."""
    y, v, u = X.unbind(-1)
    pull = p.frequency**2 * (-u / p.gain - y) - 2 * p.damping * p.frequency * v
    faster = v + 0.1 * pull
    return torch.stack([y + 0.05 * (v + faster), faster], dim=-1)


def _lag(X: Tensor, p: ParameterValues) -> Tensor:
    """A mixed vessel: what flows out follows what flows in, which falls with the gas rate."""
    y, u = X.unbind(-1)
    share = 1 - torch.exp(-1 / p.lag)
    return (y + share * (p.base - p.gain * u - y)).unsqueeze(-1)


def _two_lags(X: Tensor, p: ParameterValues) -> Tensor:
    """Two mixed vessels, one after the other."""
    y, mixed, u = X.unbind(-1)
    first, second = (1 - torch.exp(-1 / lag) for lag in (p.lag, p.lag_before))
    return torch.stack(
        [y + first * (p.base - p.gain * mixed - y), mixed + second * (u - mixed)], dim=-1
    )


def _belt(X: Tensor, p: ParameterValues) -> Tensor:
    """A pulley on an elastic belt behind motors that lag; the sensor has no sign."""
    _, speed, rate, motor, u = X.unbind(-1)
    for _ in range(4):
        motor = motor + 0.25 * (u - motor) / p.lag
        pull = p.frequency**2 * (p.gain * motor + p.offset - speed)
        rate = rate + 0.25 * (pull - 2 * p.damping * p.frequency * rate)
        speed = speed + 0.25 * rate
    return torch.stack([speed.abs(), speed, rate, motor], dim=-1)


def _stiff(X: Tensor, p: ParameterValues) -> Tensor:
    """The same behind motors that do not lag."""
    _, speed, rate, u = X.unbind(-1)
    for _ in range(4):
        pull = p.frequency**2 * (p.gain * u + p.offset - speed)
        rate = rate + 0.25 * (pull - 2 * p.damping * p.frequency * rate)
        speed = speed + 0.25 * rate
    return torch.stack([speed.abs(), speed, rate], dim=-1)


def _tanks(X: Tensor, p: ParameterValues) -> Tensor:
    """Torricelli's outflows of two equal tanks; the pump's flow is a power of its voltage."""
    lower, upper, u = X.unbind(-1)
    power = p.power if "power" in p else 1.0
    inflow = p.pump * u.clamp_min(1e-3) ** power
    for _ in range(2):
        between = p.upper_outflow * upper.clamp_min(1e-3).sqrt()
        out = p.lower_outflow * lower.clamp_min(1e-3).sqrt()
        upper, lower = upper + 0.5 * (inflow - between), lower + 0.5 * (between - out)
    return torch.stack([lower, upper], dim=-1)


def _equal_holes(X: Tensor, p: ParameterValues) -> Tensor:
    """The same of tanks with equal holes, whose areas may differ."""
    lower, upper, u = X.unbind(-1)
    inflow = p.pump * u.clamp_min(1e-3) ** p.power
    for _ in range(2):
        between, out = (p.outflow * level.clamp_min(1e-3).sqrt() for level in (upper, lower))
        upper = upper + 0.5 * (inflow - between * p.area)
        lower = lower + 0.5 * (between - out)
    return torch.stack([lower, upper], dim=-1)


_STEP_NOISE = {"learnt": None, "small": (1e-4, 1e-3), "large": (1e-3, 1e-2)}
_V = {"v": (0.0, 0.05)}
_VESSEL = {
    "base": Unknown(53.0, sd=3.0),
    "gain": Unknown(1.0, factor=2.0),
    "lag": Unknown(2.0, factor=2.0),
}
_PULLEY = {
    "gain": Unknown(1.5, factor=1.5),
    "offset": Unknown(0.0, sd=0.3),
    "frequency": Unknown(0.5, factor=1.7),
    "damping": Unknown(0.2, factor=2.0),
}
_SPEED = {"speed": (0.0, 0.1), "rate": (0.0, 0.1)}
_FLOWS = {name: Unknown(0.1, factor=2.0) for name in ("pump", "upper_outflow", "lower_outflow")}
_UPPER = {"upper": (1.0, 1.0)}
_TANK_NOISE = {"learnt": None, "even": (0.01, 0.01), "lower": (0.03, 0.003)}

SYSTEMS = {
    "ballbeam": System(
        "ballbeam.csv", "u", "y", 500, "m",
        {
            "rolling ball": Structure(
                ("y", "v"), _ball,
                {"gain": Unknown(5 / 7, factor=1.5), "friction": Unknown(0.1, factor=3.0)},
                _V, _STEP_NOISE,
            ),
            "held ball": Structure(
                ("y", "v"), _loop,
                {
                    "gain": Unknown(0.3, factor=3.0),
                    "frequency": Unknown(1.0, factor=3.0),
                    "damping": Unknown(0.7, factor=2.0),
                },
                _V, _STEP_NOISE,
            ),
        },
        (0, 20), ((10, 10), (2, 20)),
    ),
    "furnace": System(
        "gas_furnace.csv", "gas_rate", "co2", 148, "% of CO2",
        {
            **{
                f"lag, delay {k}": Structure(
                    ("y",), _lag, _VESSEL, {}, {"learnt": None, "small": (0.02,)}, k
                )
                for k in (1, 2, 3)
            },
            "two lags, delay 1": Structure(
                ("y", "mixed"), _two_lags,
                {**_VESSEL, "lag_before": Unknown(1.0, factor=2.0)},
                {"mixed": (0.0, 1.0)}, {"learnt": None, "small": (0.02, 0.01)}, 1,
            ),
        },
        (0, 3), ((3, 3), (2, 5)),
    ),
    "drive": System(
        "drive.csv", "u1", "z1", 250, "",
        {
            "stiff motors": Structure(
                ("y", "speed", "rate"), _stiff, _PULLEY, _SPEED,
                {"learnt": None, "small": (0.03, 0.03, 0.03)},
            ),
            "motors that lag": Structure(
                ("y", "speed", "rate", "motor"), _belt,
                {**_PULLEY, "lag": Unknown(3.0, factor=2.0)},
                {**_SPEED, "motor": (0.0, 1.0)},
                {"learnt": None, "small": (0.03, 0.03, 0.03, 0.01),
                 "belt": (0.01, 0.1, 0.1, 0.01)},
            ),
        },
        (0,), ((10, 10), (3, 3)),
    ),
    "tanks": System(
        "two_tanks.csv", "u", "y1", 1250, "V",
        {
            "flow as the voltage": Structure(("y", "upper"), _tanks, _FLOWS, _UPPER, _TANK_NOISE),
            "flow as its power": Structure(
                ("y", "upper"), _tanks, {**_FLOWS, "power": Unknown(1.0, factor=1.5)},
                _UPPER, _TANK_NOISE,
            ),
        },
        (0,), ((3, 1), (3, 3)), ("y2", "upper"),
        {
            "equal holes": Structure(
                ("y", "upper"), _equal_holes,
                {
                    **{name: Unknown(0.2, factor=2.0) for name in ("pump", "outflow")},
                    **{name: Unknown(1.0, factor=1.5) for name in ("power", "area")},
                },
                _UPPER, _TANK_NOISE,
            ),
        },
    ),
}  # fmt: skip
