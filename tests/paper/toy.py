"""An experiment of no time."""

from dataclasses import dataclass
from typing import ClassVar

from paper.common.experiment import Axes, Experiment, Table


@dataclass(frozen=True, kw_only=True)
class Toy(Experiment):
    """Squares; cases write down that they were run."""

    runs: int = 3
    jobs: int = 1
    scale: float = 1.0
    missing: bool = False

    axes: ClassVar[Axes] = {"kind": {"a": "the first", "b": "the second"}}
    packages: ClassVar[tuple[str, ...]] = ("gpadjust", "numpy")

    def check(self):
        if self.missing:
            raise ImportError("It needs a simulator; install it.")

    def describe(self, *kind):
        return {"scale": self.scale, "inner": {"kind": kind[0]}}

    def run(self, *case):
        if (self.out / "stop").exists() and case == ("a", 1):
            raise KeyboardInterrupt
        with open(self.out / "log", "a") as log:
            log.write(f"{case}\n")
        return {"value": self.scale * case[1] ** 2, "nothing": float("nan")}

    def tables(self, runs):
        return {"runs": Table("Runs", f"{len(runs)}")}

    def draw(self, runs):
        return []
