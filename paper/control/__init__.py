"""Controllers for machines as they are: systems that people know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels

HORIZONS = {
    "cart_pole": 8,
    "pendulum": 12,
    "furuta": 10,
    "quadrotor": 12,
    "double_pendulum": 12,
    "tanks": 8,
    "reacher": 8,
}
"""Steps that are planned ahead at each step, by the name of a known system."""


@dataclass(frozen=True, kw_only=True)
class Planned:
    """Settings of trials that are planned by the cross-entropy method."""

    trials: int = 5
    """real trials of a run, of which the first goes by f_p, or is random where there is none"""
    sequences: int = 64
    """that are planned at each step, in each round of the cross-entropy method"""
    rounds: int = 1
    """of these after the first"""
    first_sequences: int = 128
    """that are planned when a trial begins, of all its steps"""
    first_rounds: int = 8
    """of these after the first"""
    elites: int = 8
    """of a round"""
    spread: float = 0.15
    """of the sequences about the earlier plan, in shares of the range of the actions"""
    fit: Literal["map", "bayes"] = "map"
    """of the learnt models; "bayes", the default of the library, takes twice as long"""


@dataclass(frozen=True, kw_only=True)
class KnownSettings(Planned):
    """Settings that decide the numbers; found with the true systems and seeds of 20 and more."""

    trials: int = 3
    sequences: int = 128
    rounds: int = 0
    first_rounds: int = 2
    elites: int = 12
    networks: int = 5
    """of an ensemble"""
    training: int = 250
    """steps of Adam after each trial, of these"""


@dataclass(frozen=True, kw_only=True)
class Known(Experiment):
    """Systems that people know, with rivals on the same trials."""

    out: Path = Path("results/known")
    settings: KnownSettings = field(default_factory=KnownSettings)

    axes: ClassVar[Axes] = {
        "system": {
            "pendulum": "Pendulum-v1",
            "furuta": "Furuta pendulum",
            "quadrotor": "quadrotor",
            "double_pendulum": "pendubot",
            "tanks": "two tanks",
            "reacher": "Reacher-v5",
        },
        "learner": labels("cka", "phymean", "phy", "fitted", "gp")
        | {
            "ensemble": "f_p and an ensemble of networks",
            "networks": "an ensemble of networks",
        }
        | labels("oracle"),
    }
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "gymnasium", "mujoco")
    calls: ClassVar[tuple[str, ...]] = (
        "gpadjust.dynamics.LearnedDynamics",
        "gpadjust.control.Planner",
        "gpadjust.control.CrossEntropy",
    )

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and how far plans look."""
        return {**asdict(self.settings), "horizon": HORIZONS[kind[0]]}


@dataclass(frozen=True, kw_only=True)
class HiddenSettings(Planned):
    """Settings that decide the numbers; found with seeds of 100 and more."""

    noise: float = 0.01
    """standard deviation of the sensors' noise, in m and rad"""


@dataclass(frozen=True, kw_only=True)
class Hidden(Experiment):
    """Systems of which positions and angles alone are measured, with noise."""

    runs: int = 5
    out: Path = Path("results/hidden")
    settings: HiddenSettings = field(default_factory=HiddenSettings)

    axes: ClassVar[Axes] = {
        "system": {"cart_pole": "cart-pole", "furuta": "Furuta pendulum"},
        "learner": {
            "full": "all states, without noise",
            "filter": "positions and angles, by the filter",
            "quotient": "positions and angles, by difference quotients",
        },
    }
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "gymnasium")
    calls: ClassVar[tuple[str, ...]] = Known.calls

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and how far plans look."""
        return {**asdict(self.settings), "horizon": HORIZONS[kind[0]]}


@dataclass(frozen=True, kw_only=True)
class WallsSettings(Planned):
    """Settings that decide the numbers; found with seeds of 100 and more."""

    sequences: int = 40
    first_sequences: int = 64
    first_rounds: int = 2
    horizon: int = 8
    """steps that are planned ahead at each step"""
    probability: float = 0.95
    """of constraints holding through a trial"""


@dataclass(frozen=True, kw_only=True)
class Walls(Experiment):
    """Systems near walls, with margins of the constraints and without."""

    runs: int = 14
    """seeds with margins; half of these of the true model, a quarter of the others"""
    out: Path = Path("results/walls")
    settings: WallsSettings = field(default_factory=WallsSettings)

    axes: ClassVar[Axes] = {
        "system": {"cart": "cart in gusts", "cart-pole": "cart-pole", "tanks": "two tanks"},
        "controller": {
            "margin": "CKA, probability 0.95",
            "hard": "CKA, no margin",
            "none": "CKA, no constraint",
            "truth": "true model, no margin",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (
        "gpadjust.dynamics.LearnedDynamics",
        "gpadjust.control.Planner",
        "gpadjust.control.CrossEntropy",
    )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Fewer seeds of the rivals."""
        share = {"margin": 1, "truth": 2}.get(kind[1], 4)
        return self.seeds[: -(-self.runs // share)]


@dataclass(frozen=True, kw_only=True)
class SetpointsSettings(Planned):
    """Settings that decide the numbers; found with seeds of 100 and more."""

    trials: int = 2
    sequences: int = 48
    first_sequences: int = 48
    first_rounds: int = 4
    horizon: int = HORIZONS["tanks"]
    """steps that are planned ahead at each step"""


@dataclass(frozen=True, kw_only=True)
class Setpoints(Experiment):
    """Two tanks whose set-point moves: from trial to trial, and within a trial."""

    out: Path = Path("results/setpoints")
    settings: SetpointsSettings = field(default_factory=SetpointsSettings)

    axes: ClassVar[Axes] = {
        ("moves", "plans"): {
            ("between", "seen"): "bounds by what was seen alone",
            ("between", "default"): "default bounds",
            ("between", "wide"): "bounds given, far away",
            ("between", "oracle"): "the true system, bounds far away",
            ("within", "constant"): "believed to stay",
            ("within", "known"): "reference given",
            ("within", "oracle"): "the true system, reference given",
        },
    }
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "gymnasium")
    calls: ClassVar[tuple[str, ...]] = (
        "gpadjust.dynamics.LearnedDynamics",
        "gpadjust.control.Planner",
        "gpadjust.control.CrossEntropy",
    )


@dataclass(frozen=True, kw_only=True)
class DelaysSettings(Planned):
    """Settings that decide the numbers; found with seeds of 100 and more."""

    trials: int = 3
    first_sequences: int = 64
    elites: int = 12
    horizon: int = HORIZONS["cart_pole"]
    """steps that are planned ahead at each step"""
    hint_trials: int = 1
    """of the runs that only ask whether the delay is found, in which f_p alone plans, lightly"""
    hint_sequences: int = 16
    """of these runs, at each step and when a trial begins"""
    hint_rounds: int = 2
    """of these when a trial begins"""
    dry: float = 0.5
    """dry friction of the cart in the runs that only ask, in N, which f_p lacks"""


@dataclass(frozen=True, kw_only=True)
class Delays(Experiment):
    """The cart-pole that follows its force a step late: told or not, and found or not."""

    out: Path = Path("results/delays")
    settings: DelaysSettings = field(default_factory=DelaysSettings)
    runs: int = 5

    axes: ClassVar[Axes] = {
        "told": {
            "not": "late, not told",
            "previous": "late, told to the model (previous)",
            "physics": "late, told to f_p (physics_reads)",
            "none": "not late",
            "hint_late": "late",
            "hint_dry": "not late, dry friction",
            "hint_noisy": "not late, dry friction and noisy sensors",
        },
    }
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "gymnasium")
    calls: ClassVar[tuple[str, ...]] = Setpoints.calls

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """Four times as many of the runs that only ask whether the delay is found."""
        more = 4 if str(kind[0]).startswith("hint") else 1
        return range(self.seed, self.seed + more * self.runs)


@dataclass(frozen=True, kw_only=True)
class FirstSettings:
    """Settings that decide the numbers: nearly all are the library's defaults."""

    trials: int = 5
    """real trials of a run, of which the first goes by f_p"""


@dataclass(frozen=True, kw_only=True)
class First(Experiment):
    """The first trials of cart-poles, by the library's defaults; found with seeds of 100 on."""

    runs: int = 20
    out: Path = Path("results/first")
    settings: FirstSettings = field(default_factory=FirstSettings)

    axes: ClassVar[Axes] = {"model": {"cka": "CKA", "truth": "the true system"}}
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "gymnasium")
    calls: ClassVar[tuple[str, ...]] = (*Setpoints.calls, "gpadjust.control.MPC")


@dataclass(frozen=True, kw_only=True)
class OntimeSettings:
    """Settings that decide the numbers."""

    random_trials: int = 4
    """real trials of random actions, of 25 steps"""
    trials: int = 2
    """real trials that are planned in time"""
    horizon: float = 0.8
    """s that a plan looks ahead"""


@dataclass(frozen=True, kw_only=True)
class Ontime(Experiment):
    """Decisions of the cart-pole that have a time; measured on an idle core."""

    runs: int = 4
    out: Path = Path("results/ontime")
    settings: OntimeSettings = field(default_factory=OntimeSettings)

    axes: ClassVar[Axes] = {
        "seconds": {"none": "none", "0.1": "0.1", "0.05": "0.05", "0.02": "0.02"}
    }
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "gymnasium")
    calls: ClassVar[tuple[str, ...]] = First.calls
