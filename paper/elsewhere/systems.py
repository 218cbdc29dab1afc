"""Machines, records that are learnt from, and those elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics import Windows
from gpadjust.records import Record, Records
from gpadjust.states import StateSpec
from paper.real.machines import (
    DOUBLE_PENDULUM,
    PENDULUM,
    STEP,
    Machine,
    Parameters,
    double_pendulum,
    pendulum,
)
from paper.real.systems import DATA

Kind = Literal["in range", "beyond", "another machine"]

_LENGTH = 10  # transitions of a stretch
_MASS = 0.68  # kg, of the pendulum that is learnt from
_MOVES = 0.3  # rad/s: of the pendulum, only windows count that are measured to be faster somewhere


class Test(NamedTuple):
    """Records that are tested at.

    Args:
        what: What is other than in training.
        kind: Whether that is beyond the training range.
        files: Without their endings.
        load: Mass of the pendulum in kg.
    """

    what: str
    kind: Kind
    files: tuple[str, ...]
    load: float = _MASS


@dataclass(frozen=True)
class System:
    """A machine, and its records.

    Args:
        machine: The machine.
        train: Files that are learnt from.
        tests: By name.
        has_load: Whether the last action is the mass.
    """

    machine: Machine
    train: tuple[str, ...]
    tests: Mapping[str, Test]
    has_load: bool = False

    def describe(self) -> dict[str, Any]:
        """All that decides what is learnt, in plain values."""
        tests = {name: [*test.files, test.load] for name, test in self.tests.items()}
        return {"step": STEP, "train": [*self.train], "tests": tests}

    def stretches(self, n: int, seed: int) -> Records:
        """``n`` transitions in stretches of ten, spread over the records that are learnt from."""
        windows = self._records(self.train, _MASS).windows(_LENGTH, STEP)
        return Records.of_windows(windows.spread(n // _LENGTH, seed), self.machine.spec, STEP)

    def windows(self, test: str, length: int, number: int) -> Windows:
        """So many windows of a test, evenly spread."""
        files, load = self.tests[test].files, self.tests[test].load
        found = self._records(files, load).windows(length, STEP, stride=1)
        fast = found.states[..., found.states.shape[-1] // 2 :].abs() >= _MOVES * self.has_load
        rows = fast.any(-1).any(1).nonzero().flatten()
        places = torch.linspace(0, len(rows) - 1, min(number, len(rows))).round().long()
        return found.some(rows[places])

    def _records(self, files: tuple[str, ...], load: float) -> Records:
        paths: list[Path] = [DATA / f"{file}.csv" for file in files]
        if not self.has_load:
            return Records.read_csv(paths, self.machine.spec)
        found = Records.read_csv(paths, PENDULUM.spec, actions={"u": "tau_meas"}, segment="segment")
        return Records([_loaded(record, load) for record in found], self.machine.spec)


def _loaded(record: Record, load: float) -> Record:
    """The same with the mass as a second action."""
    actions = torch.cat([record.actions, torch.full_like(record.actions, load)], dim=1)
    return Record(record.times, record.states, actions, record.segments, record.name)


def loaded_pendulum(state: Tensor, action: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    """The pendulum with another mass, which its inertia and moment are proportional to."""
    share = action[:, 1] / _MASS
    sizes = {name: p[name] * share for name in ("inertia", "moment")}
    return pendulum(state, action, {**sizes, **{n: p[n] for n in ("viscous", "coulomb")}})


def design_c(state: Tensor, action: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    """The double pendulum of designs C.0 and C.1, with links of 0.2 and 0.3 m."""
    return double_pendulum(state, action, p, 0.2)


def _crude_c() -> Parameters:
    """The makers' model 1.0 of design C.1, links 15 % off, and no friction."""
    mass_1, inertia_1, mass_2, inertia_2 = (
        0.85 * 0.5235,
        0.85 * 0.03189,
        1.15 * 0.6256,
        1.15 * 0.05087,
    )
    frictions = ("viscous_1", "coulomb_1", "viscous_2", "coulomb_2")
    return {
        "inertia_1": inertia_1 + mass_2 * 0.2**2,
        "inertia_2": inertia_2,
        "moment_1": mass_1 * 0.2 + mass_2 * 0.2,
        "moment_2": mass_2 * 0.2557,
        "rotor": 6.29e-5,
        **dict.fromkeys(frictions, 0.0),
    }


def _of_day(day: str, *numbers: str) -> tuple[str, ...]:
    return tuple(f"double_pendulum/{day}_{number}" for number in numbers)


_LOADED = Machine(
    StateSpec(["q", "dq"], ["u", "load"], angles=["q"]), loaded_pendulum, PENDULUM.known
)
_DESIGN_C = replace(DOUBLE_PENDULUM, rates=design_c, known={"crude": _crude_c()})
_C0 = _of_day("C0_20220914", "00", "03", "05")
_C1 = _of_day("C1_20230629", "143524", "143704", "143747")
_C1_LARGER = _of_day("C1_20230629", "143339", "143601")

SYSTEMS = {
    "pendulum": System(
        _LOADED,
        ("pendulum/energy_shaping",),
        {
            "sac": Test("another controller, in range", "in range", ("pendulum/sac",)),
            "ddp": Test("up to 2.8 N m", "beyond", ("pendulum/ddp",)),
            "collocation": Test("up to 3.1 N m", "beyond", ("pendulum/direct_collocation",)),
            "1kg": Test("1 kg, told", "beyond", ("pendulum/energy_shaping_1kg",), 1.0),
        },
        has_load=True,
    ),
    "design-a": System(
        DOUBLE_PENDULUM,
        _of_day("A0_20220815", "00", "02", "03"),
        {
            "near": Test("the same day", "in range", _of_day("A0_20220815", "01", "12", "13")),
            "day": Test(
                "another day", "beyond", _of_day("A0_20220812", "055032", "055640", "055903")
            ),
            "far": Test("twice the rates", "beyond", _of_day("A0_20220815", "04", "05")),
        },
    ),
    "design-c0": System(
        _DESIGN_C, _C0, {"c1": Test("C.1", "another machine", (*_C1, *_C1_LARGER))}
    ),
    "design-c1": System(
        _DESIGN_C,
        _C1,
        {
            "larger": Test("twice the angles and rates", "beyond", _C1_LARGER),
            "c0": Test("C.0", "another machine", _C0),
        },
    ),
}
"""By name of the training."""
