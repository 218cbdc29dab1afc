"""The pendulums' records, cut into those that are learnt from and those that are tested at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gpadjust.dynamics import Trajectories, Windows
from gpadjust.records import Records
from paper.machines.pendulums import DOUBLE_PENDULUM, PENDULUM, STEP, SUBSTEPS, Machine

DATA = Path(__file__).parent / "data"
_LENGTH = 10  # transitions of a stretch
_MOVES = 0.3  # rad/s: of the pendulum's tests only what is measured to be faster somewhere counts


def folder_of(machine: str) -> Path:
    """Return where the records of a machine are; those of the pendulum are in the library."""
    own = files("gpadjust.records") / "pendulum"
    return Path(str(own)) if machine == "pendulum" else DATA / machine


@dataclass(frozen=True)
class System:
    """Records of a machine, of which some are learnt from and others are tested at."""

    machine: Machine  # the machine
    folder: str  # the machine, of `folder_of`
    train: tuple[str, ...]  # files that are learnt from, without their endings
    tests: Mapping[str, tuple[str, ...]]  # files of each test, by its name
    segment: str | None = None  # the column of segments
    moves: float = 0.0  # a rate in rad/s that what is tested at reaches

    def describe(self) -> dict[str, Any]:
        """Return all that decides what is learnt, in plain values."""
        return {
            "step": STEP,
            "substeps": SUBSTEPS,
            "train": list(self.train),
            "tests": {name: list(files) for name, files in self.tests.items()},
            "moves": self.moves,
            **{name: dict(parameters) for name, parameters in self.machine.known.items()},
        }

    def drawn(self, n: int, seed: int) -> Trajectories:
        """Return ``n`` transitions to learn from, spread over the records.

        Raises:
            ValueError: If the records have fewer.
        """
        return self._records(self.train).trajectories(STEP).spread(n, seed)

    def stretches(self, n: int, seed: int) -> Records:
        """Return ``n`` transitions in stretches of ten, or as many as divide ``n``, spread alike.

        Raises:
            ValueError: If the records have fewer.
        """
        length = max(k for k in range(1, _LENGTH + 1) if n % k == 0)
        found = self._records(self.train).windows(length, STEP).spread(n // length, seed)
        return Records.of_windows(found, self.machine.spec, STEP)

    def steps(self, test: str) -> Trajectories:
        """Return the single steps of a test that start where the machine moves."""
        data = self._records(self.tests[test]).trajectories(STEP)
        return data.subset(self._fast(data.states).nonzero().flatten())

    def windows(self, test: str, length: int, number: int) -> Windows:
        """Return so many windows of a test in which the machine moves, evenly spread."""
        found = self._records(self.tests[test]).windows(length, STEP, stride=1)
        rows = self._fast(found.states).any(1).nonzero().flatten()
        places = torch.linspace(0, len(rows) - 1, min(number, len(rows))).round().long()
        return found.subset(rows[places])

    def _fast(self, states: Tensor) -> Tensor:
        """Return a mask of states with a rate above the threshold, in a state's second half."""
        rates = states[..., states.shape[-1] // 2 :]
        return (rates.abs() >= self.moves).any(-1)

    def _records(self, files: tuple[str, ...]) -> Records:
        paths = [folder_of(self.folder) / f"{file}.csv" for file in files]
        spec = self.machine.spec
        return Records.read_csv(paths, spec, segment=self.segment)


def _a(*numbers: str) -> tuple[str, ...]:
    return tuple(f"A0_20220815_{number}" for number in numbers)


REAL = {
    "double-pendulum": System(
        DOUBLE_PENDULUM,
        "double_pendulum",
        _a("00", "02", "03"),
        {"near": _a("01", "12", "13"), "far": _a("04", "05")},
    ),
    "pendulum": System(
        PENDULUM, "pendulum", ("energy_shaping",), {"sac": ("sac",)}, "segment", _MOVES
    ),
}
"""The systems of the experiment ``real``, by name."""
