"""Data as laboratories have them: each kind beside what ignores it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from paper.common.experiment import Axes, Experiment


@dataclass(frozen=True, kw_only=True)
class BalldropSettings:
    """What decides the numbers."""

    num_runs: int = 80
    """runs of the simulator, the first ones: those that the documentation of SEPIA takes"""
    heights: tuple[int, ...] = (10, 20, 30, 40, 50, 60)
    """heights in m at which the runs are taken"""


@dataclass(frozen=True, kw_only=True)
class Balldrop(Experiment):
    """Drop times of three balls, and runs of a simulator: the fourth ball is predicted."""

    runs: int = 2
    """fits of each case, by other seeds"""
    out: Path = Path("results/balldrop")
    settings: BalldropSettings = field(default_factory=BalldropSettings)

    axes: ClassVar[Axes] = {
        "physics": {"runs": "80 runs", "formula": "its formula"},
        "left": {
            "softball": "softball",
            "basketball": "basketball",
            "baseball": "baseball",
            "bowling ball": "bowling ball",
            "none": "none",
        },
        "model": {
            "physics": "calibrated physics",
            "mean": "physics mean",
            "cka": "CKA",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.PhysicsMeanGP"),
        *("gpadjust.CalibratedPhysics", "gpadjust.EmulatedPhysics"),
    )


@dataclass(frozen=True, kw_only=True)
class Categories(Experiment):
    """Pumps of three materials on five rigs, of which each has an offset."""

    runs: int = 24
    """sets of pumps"""
    out: Path = Path("results/categories")

    axes: ClassVar[Axes] = {
        "model": {
            "ignored": "material and rig ignored",
            "each": "a model of each material",
            "numbers": "codes as numbers",
            "onehot": "one-hot columns as numbers",
            "ours": "categorical, batch",
        },
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")


@dataclass(frozen=True, kw_only=True)
class DriftSettings:
    """Settings that decide the numbers, fixed before the first run."""

    steps: int = 2190
    """observations, one each two hours: half a year"""
    first: int = 84
    """of these before the first fit: a week"""
    refit_every: int = 12
    """observations between refits of what is fitted again: a day"""
    window: int = 84
    """observations that an exact model keeps: a week"""
    refit_window: int = 84
    """observations that are fitted again: a week"""
    forget: int = 42
    """observations in which an RRA forgets"""
    method: str = "map"
    """of all fits"""
    num_features: int = 64
    """features of each term of an RRA"""


@dataclass(frozen=True, kw_only=True)
class Drift(Experiment):
    """Half a year of a pump that wears, predicted a step ahead by models that are updated."""

    runs: int = 6
    """pumps"""
    out: Path = Path("results/drift")
    settings: DriftSettings = field(default_factory=DriftSettings)

    axes: ClassVar[Axes] = {
        "model": {
            "never": "CKA, fitted once",
            "rra": "RRA, updated",
            "cka": "CKA, updated",
            "refit": "CKA, updated, and fitted again each day",
            "steady": "RRA, updated, of a pump that does not wear",
        }
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.RRA")


@dataclass(frozen=True, kw_only=True)
class EmulatedSettings:
    """What decides the numbers."""

    per_input: int = 5
    """observations for each input"""
    runs_per_input: int = 20
    """runs of the low level for each input: at the observed inputs, and on a Sobol sequence"""
    num_test: int = 1000
    """points that all models are scored at"""


@dataclass(frozen=True, kw_only=True)
class Emulated(Experiment):
    """A physics known by its runs, on six pairs of functions of low and high fidelity."""

    runs: int = 10
    """data sets of each pair"""
    out: Path = Path("results/emulated")
    settings: EmulatedSettings = field(default_factory=EmulatedSettings)

    axes: ClassVar[Axes] = {
        "pair": {
            name: name
            for name in ("currin", "branin", "bohachevsky", "booth", "park91a", "hartmann6")
        },
        "model": {
            "exact": "CKA, exact f_p",
            "emulated": "CKA, f_p emulated",
            "certain": "CKA, emulator taken as exact",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.EmulatedPhysics"),
    )


@dataclass(frozen=True, kw_only=True)
class Links(Experiment):
    """Positive and bounded outputs: a link, with the physics through it, beside none."""

    runs: int = 24
    """cases of each problem"""
    out: Path = Path("results/links")

    axes: ClassVar[Axes] = {
        "problem": {
            "rate": "reaction rate, 4 decades",
            "diode": "current of a diode, 6 decades",
            "pump": "efficiency of a pump, 0 to 1",
            "reactor": "conversion in a reactor, 0 to 1",
        },
        "model": {"default": "CKA", "gp": "GP with the link", "linked": "CKA with the link"},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.ZeroMeanGP")


@dataclass(frozen=True, kw_only=True)
class NoisyinputsSettings:
    """Settings that decide the numbers, fixed before the first run."""

    observations: int = 40
    """of a function"""
    observations_of_law: int = 100
    """of a law whose parameters are asked for"""
    input_noise: float = 0.05
    """standard deviation of an input's error, in its range"""
    noise: float = 0.02
    """standard deviation of an output's error, in its range"""


@dataclass(frozen=True, kw_only=True)
class Noisyinputs(Experiment):
    """Inputs that were measured with noise: errors, coverage, and parameters without bias."""

    runs: int = 12
    """cases of each problem"""
    seed: int = 5000
    """the first seed; 1000 to 1099 were for trying"""
    out: Path = Path("results/noisyinputs")
    settings: NoisyinputsSettings = field(default_factory=NoisyinputsSettings)

    axes: ClassVar[Axes] = {
        "problem": {
            "wave": "wave",
            "step": "step",
            "forrester": "Forrester",
            "heat": "heat (2 inputs)",
            "pump": "pump (2 inputs)",
            "line": "line: slope",
            "decay": "decay: rate",
            "saturation": "saturation: limit",
        },
        "model": {"ignoring": "ignoring it", "noisy": "train_Xvar"},
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CKA", "gpadjust.CalibratedPhysics"),
    )


@dataclass(frozen=True, kw_only=True)
class Outliers(Experiment):
    """One in twenty observations is far off: errors beside those of clean data."""

    runs: int = 5
    """cases of each problem and size"""
    out: Path = Path("results/outliers")

    axes: ClassVar[Axes] = {
        "problem": {
            "wave": "wave: f_p lacks a slope",
            "decay": "decay: a wrong rate",
            "plane": "plane: two inputs",
            "good": "good: f_p is 2 % off",
            "misleading": "misleading: f_p is of no use",
            "space": "space: three inputs",
        },
        "observations": {20: "20", 60: "60"},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA")


@dataclass(frozen=True, kw_only=True)
class Relative(Experiment):
    """Noise that grows with an output over three decades: do intervals hold in each?"""

    runs: int = 12
    """cases of each problem"""
    observations: int = 40
    """training points"""
    out: Path = Path("results/relative")

    axes: ClassVar[Axes] = {
        "problem": {
            "rate": "rate: exponential",
            "power": "power: a wrong exponent",
            "plane": "plane: f_p lacks an input",
        },
        "structure": {"CKA": "CKA", "GP": "GP without physics"},
        "noise": {"default": "one size", "relative": "relative"},
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.fit", "gpadjust.CKA", "gpadjust.ZeroMeanGP")


@dataclass(frozen=True, kw_only=True)
class Vanishing(Experiment):
    """A delta that is zero where the formula is known to be right: is the true parameter held?"""

    runs: int = 100
    """cases of each problem"""
    out: Path = Path("results/vanishing")

    axes: ClassVar[Axes] = {
        "problem": {
            "ball": "ball: drag is missing, taken as none until 0.5 s",
            "early": "ball, until 0.3 s, of new seeds",
            "valve": "valve: its loss is missing, none when open",
            "misplaced": "valve, taken as open at 0.8",
        },
        "model": {
            "physics": "calibrated physics",
            "free": "free delta",
            "orthogonal": "orthogonal delta",
            "vanishing": "vanishing delta",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (
        *("gpadjust.fit", "gpadjust.CalibratedPhysics", "gpadjust.PhysicsMeanGP"),
    )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Other places are of the vanishing delta alone, and one was chosen after the first run."""
        if kind[0] in ("early", "misplaced") and kind[1] != "vanishing":
            return ()
        return range(3000, 3000 + self.runs) if kind[0] == "early" else self.seeds
