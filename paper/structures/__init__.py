"""Does the richer model pay? CKA and RRA beside the physics mean and the plain GP, cell by cell."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from paper.calibration import PUMP as _PUMP
from paper.calibration import ROWS
from paper.common.experiment import Experiment, Task

Model = Literal["cka", "phy", "gp", "rra"]
MODELS: tuple[Model, ...] = get_args(Model)
LABELS = {"cka": "CKA", "phy": "physics mean", "gp": "GP", "rra": "RRA"}
CLASSES = {"cka": "CKA", "phy": "PhysicsMeanGP", "gp": "ZeroMeanGP", "rra": "RRA"}
PUMP = _PUMP[0]
ARM = "arm"
SIMULATED = (ARM, "cart-pole")
MEASURED = ("pendulum", "double-pendulum")
# Problem, observations per input or number of transitions, noise that is added.
CELLS: tuple[tuple[str, int, float], ...] = (
    *ROWS,
    (PUMP, 6, 1.0),
    *((name, n, 0.0) for name in SIMULATED for n in (30, 75, 150)),
    *((name, n, 0.0) for name in MEASURED for n in (50, 100, 200)),
)
GROUPS = {
    **dict.fromkeys((name for name, *_ in ROWS), "functions"),
    PUMP: "functions",
    **dict.fromkeys(SIMULATED, "simulated systems"),
    **dict.fromkeys(MEASURED, "real machines"),
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    num_test: int = 1000
    """points of a function that all runs are scored at"""
    num_pump: int = 12
    """observations of the pump"""
    num_transitions: int = 300
    """of a simulated system, that all runs are scored at"""


@dataclass(frozen=True, kw_only=True)
class Structures(Experiment):
    """CKA and RRA beside the models that they contain, on functions, transitions and records."""

    runs: int = 5
    """data sets of each cell"""
    out: Path = Path("results/structures")
    models: tuple[Model, ...] = MODELS
    """that are fitted"""
    problems: tuple[str, ...] = tuple(GROUPS)
    """that they are fitted to"""
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "structures"
    key: ClassVar[tuple[str, ...]] = ("problem", "size", "noise", "model", "seed")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "opensim")

    def check(self) -> None:
        """Raise a ValueError for an unknown problem, an ImportError if OpenSim is missing."""
        unknown = [name for name in self.problems if name not in GROUPS]
        if unknown:
            raise ValueError(f"There is no problem {unknown[0]!r}; there are {', '.join(GROUPS)}.")
        if ARM in self.problems and find_spec("opensim") is None:
            raise ImportError('The arm needs OpenSim; run `pip install "gpadjust[arm]"`.')

    def tasks(self) -> list[Task]:
        """Each model on each data set, seed by seed."""
        cells = [cell for cell in CELLS if cell[0] in self.problems]
        return [(*cell, m, s) for s in self.seeds for m in self.models for cell in cells]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings that a run depends on."""
        needed = {"functions": "num_test", "simulated systems": "num_transitions"}
        name = "num_pump" if kind[0] == PUMP else needed.get(GROUPS[kind[0]])
        return {k: v for k, v in asdict(self.settings).items() if k == name}
