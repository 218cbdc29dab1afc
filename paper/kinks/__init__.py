"""Next states of systems with kinks and of smooth ones, without sensor noise: do intervals hold?"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Experiment, Task

KINKS = {
    "stick-slip": "mass on a moving belt",
    "cart-pole": "cart-pole, dry friction",
    "bouncing": "bouncing ball",
    "backlash": "gear with backlash",
    "thermostat": "switched heater",
}
SMOOTH = {
    "smooth cart-pole": "cart-pole, viscous friction",
    "reactor": "stirred tank reactor",
    "oscillator": "van der Pol's oscillator",
    "two links": "two driven links",
}
DATA = ("scattered", "episodes")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What decides the numbers."""

    held_out: int = 400
    """transitions that are predicted"""
    steps: int = 20
    """of an episode; its actions change every fourth step"""


@dataclass(frozen=True, kw_only=True)
class Kinks(Experiment):
    """Intervals of next states, as they are and as the kernels alone have them."""

    runs: int = 5
    """data sets of each kind"""
    seed: int = 700
    """the first seed; 0 to 99 were for trying, of other systems"""
    out: Path = Path("results/kinks")
    systems: tuple[str, ...] = (*KINKS, *SMOOTH)
    """whose transitions are predicted"""
    data: tuple[str, ...] = DATA
    """random states and actions, or the steps of episodes, in any order"""
    sizes: tuple[int, ...] = (100, 300)
    """numbers of transitions to learn from"""
    settings: Settings = field(default_factory=Settings)

    name: ClassVar[str] = "kinks"
    key: ClassVar[tuple[str, ...]] = ("system", "data", "n", "seed")

    def check(self) -> None:
        """Refuse systems and data that there are none of."""
        for found, known in ((self.systems, (*KINKS, *SMOOTH)), (self.data, DATA)):
            if not {*found} <= {*known}:
                raise ValueError(f"Expected some of {', '.join(known)}, found {', '.join(found)}.")
        if min(self.sizes) < 2:
            raise ValueError(f"Expected sizes of at least 2 transitions, found {min(self.sizes)}.")

    def tasks(self) -> list[Task]:
        """All systems by one seed before the next one."""
        return [
            (system, data, n, seed)
            for seed in self.seeds
            for n in self.sizes
            for data in self.data
            for system in self.systems
        ]

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings."""
        return asdict(self.settings)
