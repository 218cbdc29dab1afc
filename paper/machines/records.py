"""The pendulums' records, cut into those that are learnt from and those that are tested at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics import Trajectories, Windows
from gpadjust.records import Record, Records
from paper.machines.pendulums import (
    DESIGN_C,
    DOUBLE_PENDULUM,
    LOADED,
    PENDULUM,
    STEP,
    SUBSTEPS,
    Machine,
)

DATA = Path(__file__).parent / "data"
_LENGTH = 10  # transitions of a stretch
_MASS = 0.68  # kg, of the pendulum that is learnt from
_MOVES = 0.3  # rad/s: of the pendulum's tests only what is measured to be faster somewhere counts


class Test(NamedTuple):
    """Records that are tested at.

    Args:
        files: Without their endings.
        what: What is other than in training.
        kind: ``"in range"`` of the training, ``"beyond"`` it, or ``"another machine"``.
        load: Mass of the pendulum in kg, where it is an action.
    """

    files: tuple[str, ...]
    what: str = ""
    kind: str = "in range"
    load: float = _MASS


@dataclass(frozen=True)
class System:
    """Records of a machine, of which some are learnt from and others are tested at.

    Args:
        machine: The machine.
        folder: Where the files are in ``DATA``.
        train: Files that are learnt from, without their endings.
        tests: Those of each test, by its name.
        actions: Columns of the actions that are called otherwise there.
        segment: The column of segments.
        moves: A rate in rad/s that what is tested at reaches.
    """

    machine: Machine
    folder: str
    train: tuple[str, ...]
    tests: Mapping[str, Test]
    actions: Mapping[str, str] = field(default_factory=dict)
    segment: str | None = None
    moves: float = 0.0

    def describe(self) -> dict[str, Any]:
        """Everything that decides what is learnt, in plain values."""
        return {
            "step": STEP,
            "substeps": SUBSTEPS,
            "train": list(self.train),
            "tests": {name: list(test.files) for name, test in self.tests.items()},
            "actions": dict(self.actions),
            "moves": self.moves,
            **{name: dict(parameters) for name, parameters in self.machine.known.items()},
        }

    def drawn(self, n: int, seed: int) -> Trajectories:
        """``n`` transitions to learn from, spread over the records; of 0 none.

        Raises:
            ValueError: If the records have fewer.
        """
        known = self._records(Test(self.train)).trajectories(STEP)
        return known.spread(n, seed) if n else known.some(slice(0))

    def stretches(self, n: int, seed: int) -> Records:
        """``n`` transitions in stretches of ten, or as many as divide ``n``, spread alike.

        Raises:
            ValueError: If the records have fewer.
        """
        length = max(k for k in range(1, _LENGTH + 1) if n % k == 0)
        found = self._records(Test(self.train)).windows(length, STEP).spread(n // length, seed)
        return Records.of_windows(found, self.machine.spec, STEP)

    def steps(self, test: str) -> Trajectories:
        """The single steps of a test that start where the machine moves."""
        data = self._records(self.tests[test]).trajectories(STEP)
        return data.some(self._fast(data.states).nonzero().flatten())

    def windows(self, test: str, length: int, number: int) -> Windows:
        """So many windows of a test in which the machine moves, evenly spread."""
        found = self._records(self.tests[test]).windows(length, STEP, stride=1)
        rows = self._fast(found.states).any(1).nonzero().flatten()
        places = torch.linspace(0, len(rows) - 1, min(number, len(rows))).round().long()
        return found.some(rows[places])

    def _fast(self, states: Tensor) -> Tensor:
        """Mask of states with a rate above the threshold; rates are the second half of a state."""
        rates = states[..., states.shape[-1] // 2 :]
        return (rates.abs() >= self.moves).any(-1)

    def _records(self, test: Test) -> Records:
        files = [DATA / self.folder / f"{file}.csv" for file in test.files]
        loaded = self.machine is LOADED
        spec = PENDULUM.spec if loaded else self.machine.spec
        found = Records.read_csv(files, spec, actions=self.actions, segment=self.segment)
        if not loaded:
            return found
        return Records([_with_load(record, test.load) for record in found], self.machine.spec)


def _with_load(record: Record, load: float) -> Record:
    """The same with the mass as a second action."""
    actions = torch.cat([record.actions, torch.full_like(record.actions, load)], dim=1)
    return Record(record.times, record.states, actions, record.segments, record.name)


def _a(*numbers: str, day: str = "15") -> tuple[str, ...]:
    return tuple(f"A0_202208{day}_{number}" for number in numbers)


_DOUBLE = "double_pendulum"
_C0 = tuple(f"C0_20220914_{number}" for number in ("00", "03", "05"))
_C1 = tuple(f"C1_20230629_{number}" for number in ("143524", "143704", "143747"))
_C1_LARGER = tuple(f"C1_20230629_{number}" for number in ("143339", "143601"))
_PENDULUM: dict[str, Any] = {
    "folder": "pendulum",
    "train": ("energy_shaping",),
    "segment": "segment",
    "moves": _MOVES,
}
_MEASURED = {"u": "tau_meas"}

REAL = {
    "double-pendulum": System(
        DOUBLE_PENDULUM,
        _DOUBLE,
        _a("00", "02", "03"),
        {"near": Test(_a("01", "12", "13")), "far": Test(_a("04", "05"))},
    ),
    "double-pendulum-harder": System(
        DOUBLE_PENDULUM,
        _DOUBLE,
        _a("01", "02", "03"),
        {"harder": Test(_a("00", "12", "13"))},
    ),
    "pendulum": System(PENDULUM, **_PENDULUM, tests={"sac": Test(("sac",))}),
    "pendulum-measured": System(
        PENDULUM, **_PENDULUM, tests={"ddp": Test(("ddp",))}, actions=_MEASURED
    ),
}
"""The systems of the experiment ``real``, by name."""

ELSEWHERE = {
    "pendulum": System(
        LOADED,
        **_PENDULUM,
        tests={
            "sac": Test(("sac",), "another controller, in range"),
            "ddp": Test(("ddp",), "up to 2.8 N m", "beyond"),
            "collocation": Test(("direct_collocation",), "up to 3.1 N m", "beyond"),
            "1kg": Test(("energy_shaping_1kg",), "1 kg, told", "beyond", 1.0),
        },
        actions=_MEASURED,
    ),
    "design-a": System(
        DOUBLE_PENDULUM,
        _DOUBLE,
        _a("00", "02", "03"),
        {
            "near": Test(_a("01", "12", "13"), "the same day"),
            "day": Test(_a("055032", "055640", "055903", day="12"), "another day", "beyond"),
            "far": Test(_a("04", "05"), "twice the rates", "beyond"),
        },
    ),
    "design-c0": System(
        DESIGN_C, _DOUBLE, _C0, {"c1": Test((*_C1, *_C1_LARGER), "C.1", "another machine")}
    ),
    "design-c1": System(
        DESIGN_C,
        _DOUBLE,
        _C1,
        {
            "larger": Test(_C1_LARGER, "twice the angles and rates", "beyond"),
            "c0": Test(_C0, "C.0", "another machine"),
        },
    ),
}
"""The systems of the experiment ``elsewhere``, by the name of the training."""
