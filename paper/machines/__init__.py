"""Dynamics learnt from records: of real machines, beyond the training, at kinks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from paper.arm import Arm
from paper.cartpole import CartPole, Control
from paper.common.experiment import Axes, Experiment
from paper.common.learners import LEARNERS, Learner

HORIZONS = (10, 20, 40)
"""Steps of 0.05 s after which free runs are scored, of ``real`` beside the single steps."""

_DYNAMICS = ("gpadjust.dynamics.LearnedDynamics", "gpadjust.dynamics.Dynamics.free_run")


@dataclass(frozen=True)
class RealLearner(Learner):
    """A learner of a machine.

    Args:
        physics: The f_p that it has: ``"crude"``, ``"identified"``, ``"unknown"`` (its parameters
            are learnt), ``"fitted"`` (they are fitted by least squares first), or none.
        states: What it learns from: ``"transitions"``, ``"stretches"`` of ten of them, or
            ``"smoothed"`` states along such stretches.
    """

    physics: str = "crude"
    states: str = "transitions"


def _of(name: str, label: str, color: str, physics: str, states: str = "transitions") -> Any:
    """The learner of a name of the registry with another f_p, or of other states."""
    known = LEARNERS[name]
    options = known.options
    return RealLearner(label, color, known.model, options, known.adjusts, physics, states)


REAL_LEARNERS = {
    "phy": _of("phy", "f_p, crude", "tab:orange", "crude"),
    "phy-identified": _of("phy", "f_p, identified", "gold", "identified"),
    "fitted": _of("fitted", "f_p, least squares", "tab:brown", "fitted"),
    "gp": _of("gp", "GP", "tab:red", "none"),
    "phymean": _of("phymean", "physics mean", "tab:purple", "crude"),
    "phymean-identified": _of("phymean", "physics mean, identified", "plum", "identified"),
    "phymean-fitted": _of("phymean", "physics mean, least squares", "black", "fitted"),
    "cka": _of("cka", "CKA", "navy", "crude"),
    "cka-identified": _of("cka", "CKA, identified", "tab:cyan", "identified"),
    "rra": _of("rra", "RRA", "tab:green", "crude"),
    "rra-identified": _of("rra", "RRA, identified", "yellowgreen", "identified"),
    "calibrated": _of("calibrated", "calibrated f_p", "tab:olive", "unknown"),
    "calibrated-delta": _of("phymean", "calibrated f_p + delta", "deepskyblue", "unknown"),
    "calibrated-orthogonal": RealLearner(
        "calibrated f_p + orthogonal delta", "teal", "PhysicsMeanGP", physics="unknown"
    ),
    "calibrated-cka": _of("cka", "calibrated CKA", "blue", "unknown"),
    "stretches-delta": _of(
        "phymean", "calibrated f_p + delta, of stretches", "slategray", "unknown", "stretches"
    ),
    "smoothed": _of("calibrated", "calibrated f_p, smoothed", "darkkhaki", "unknown", "smoothed"),
    "smoothed-delta": _of(
        "phymean", "calibrated f_p + delta, smoothed", "limegreen", "unknown", "smoothed"
    ),
    "smoothed-cka": _of("cka", "calibrated CKA, smoothed", "darkviolet", "unknown", "smoothed"),
    "network": RealLearner("network", "0.55", "network", physics="none"),
    "residual": RealLearner("f_p and a network", "tab:pink", "network"),
}
UNTRAINED = ("phy", "phy-identified")
"""Learners that learn nothing: one run each, of 0 transitions."""


@dataclass(frozen=True, kw_only=True)
class RealSettings:
    """Settings that decide the numbers, fixed before the first run."""

    windows: int = 80
    """free runs of a test, from evenly spread states, the same for all learners"""
    num_functions: int = 39
    """particles of a free run"""
    drawn: int = 100
    """transitions of the runs of seed 0 that keep a few free runs, for the figures"""


@dataclass(frozen=True, kw_only=True)
class Real(Experiment):
    """Dynamics learnt from some transitions of a real machine, scored at other records."""

    out: Path = Path("results/real")
    settings: RealSettings = field(default_factory=RealSettings)

    axes: ClassVar[Axes] = {
        "system": {
            "double-pendulum": "double pendulum",
            "double-pendulum-harder": "double pendulum, harder split",
            "pendulum": "torque-limited pendulum",
            "pendulum-measured": "torque-limited pendulum, measured torques",
        },
        "n": {n: f"n = {n}" for n in (0, 25, 50, 100, 200, 300, 400)},
        "learner": {name: learner.label for name, learner in REAL_LEARNERS.items()},
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scipy")

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """One run of what learns nothing; the pendulums' records have 300 transitions at most."""
        system, n, learner = kind
        if learner in UNTRAINED or n == 0:
            return self.seeds[:1] if learner in UNTRAINED and n == 0 else ()
        return () if n == (400 if system.startswith("pendulum") else 300) else self.seeds

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings of a run, and the records and parameters of its system."""
        from paper.machines.records import REAL

        scored: dict[str, Any] = {"horizons": list(HORIZONS), "start_noise": "learnt"}
        scored |= {"fitted_by": "PhysicsDynamics"} if "fitted" in kind[2] else {}
        return {**asdict(self.settings), **scored, **REAL[kind[0]].describe()}


TRAININGS = {
    "pendulum": "pendulum, 0.68 kg, up to 1.3 N m",
    "design-a": "double pendulum A.0",
    "design-c0": "double pendulum C.0",
    "design-c1": "double pendulum C.1, small motions",
}
ANOTHER = 0.2
"""Standard deviations of priors, by which parameters of another machine are taken to differ."""


@dataclass(frozen=True, kw_only=True)
class ElsewhereSettings:
    """Settings that decide the numbers."""

    n: int = 100
    """transitions that are learnt from, in stretches of ten"""
    windows: int = 40
    """free runs of a test, from evenly spread states, the same for all learners"""
    num_functions: int = 39
    """particles of a free run"""


@dataclass(frozen=True, kw_only=True)
class Elsewhere(Experiment):
    """Coverage and widths of free runs where the training records have not been."""

    runs: int = 2
    """draws of the stretches that are learnt from"""
    seed: int = 10
    """the first seed; 0 to 9 were for trying"""
    out: Path = Path("results/elsewhere")
    settings: ElsewhereSettings = field(default_factory=ElsewhereSettings)

    axes: ClassVar[Axes] = {
        "training": TRAININGS,
        "learner": {
            "fitted": "f_p, least squares, constant sd",
            "gp": "GP",
            "smoothed": "calibrated CKA, smoothed",
        },
    }
    calls: ClassVar[tuple[str, ...]] = (*_DYNAMICS, "gpadjust.records.smooth")
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "scipy")

    def check(self) -> None:
        """Refuse a number of transitions that is not one of stretches."""
        if self.settings.n < 20 or self.settings.n % 10:
            raise ValueError(f"--n: expected 20, 30, ..., got {self.settings.n}")

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and the files."""
        from paper.machines.records import ELSEWHERE

        known = ELSEWHERE[kind[0]]
        tests = {
            name: [*(f"{known.folder}/{file}" for file in test.files), test.load]
            for name, test in known.tests.items()
        }
        train = [f"{known.folder}/{file}" for file in known.train]
        found = {"step": known.describe()["step"], "train": train, "tests": tests}
        found |= {"fitted_by": "PhysicsDynamics"} if kind[1] == "fitted" else {}
        return {**asdict(self.settings), "another": ANOTHER, **found}


STRUCTURES = {
    "overflow": "overflow, linear sensor",
    "sensor": "overflow, root sensor",
    "kink": "overflow, kinked sensor",
}
"""Structures of the tanks' f_p, by name (``tanks_systems.py``)."""

PROCESS_NOISE = {
    "small": (0.003, 0.001),
    "middle": (0.01, 0.005),
    "large": (0.03, 0.015),
    "learnt": None,
}
"""Process noise of a step of 4 s in the levels of the upper and the lower tank, in V."""

CANDIDATES = {
    f"{structure}-{noise}": f"f_p: {label}; process noise "
    + ("learnt" if sd is None else f"{sd[0]:g}, {sd[1]:g}")
    for structure, label in STRUCTURES.items()
    for noise, sd in PROCESS_NOISE.items()
}
"""f_p with parameters from all samples, between which cross-validation chooses."""

NARX = {
    f"narx-{lags}": f"GP of {lags} level{'s' * (lags > 1)} and action{'s' * (lags > 1)}, no f_p"
    for lags in (1, 2, 3, 5)
}
"""GPs without f_p, by the levels and actions that they read; cross-validation chooses, too."""

TENTH = "tenth"
GPS = {
    "delta": "chosen f_p + delta",
    "cka": "CKA of the chosen f_p",
    "overflow-delta": "f_p of a linear sensor + delta",
    "overflow-cka": "CKA of f_p of a linear sensor",
}
"""GPs beside an f_p whose parameters are those of its fit, by name."""

CHOSEN = {"": "kink-small", "overflow": "overflow-middle"}
"""The candidates, of all and of those with a linear sensor, that the cross-validated errors of the
committed runs choose: f_p of the learners that have one. The tables say so if other runs differ."""


@dataclass(frozen=True, kw_only=True)
class TanksSettings:
    """Settings that decide the numbers, fixed before the first run."""

    samples: int = 1024
    """of each record, the first ones"""
    head: int = 60
    """samples before the first block of the cross-validation"""
    blocks: int = 4
    """of the cross-validation"""
    noise: float = 0.15
    """standard deviation of the measured level in V, unless it is learnt with the process noise"""
    starts: int = 2
    """of each fit of f_p"""
    rounds: int = 100
    """of each start, at most"""
    num_functions: int = 39
    """particles of a free run"""


@dataclass(frozen=True, kw_only=True)
class Tanks(Experiment):
    """Dynamics of two tanks, learnt from one record, by a free run along another one."""

    out: Path = Path("results/tanks")
    settings: TanksSettings = field(default_factory=TanksSettings)

    axes: ClassVar[Axes] = {
        "n": {1024: "all samples", 100: "100", 400: "400"},
        "learner": {**CANDIDATES, TENTH: "chosen f_p, every tenth sample", **GPS, **NARX},
    }
    calls: ClassVar[tuple[str, ...]] = (*_DYNAMICS, "gpadjust.records.smooth")

    def check(self) -> None:
        """Refuse a number of samples that leaves a block without two."""
        own = self.settings
        if not own.head + 2 * own.blocks <= own.samples <= 1024:
            raise ValueError(
                f"--samples: expected at most 1024, and two for each of {own.blocks} blocks after "
                f"the first {own.head}, got {own.samples}"
            )

    def seeds_of(self, *kind: Any) -> Sequence[int]:
        """A candidate has all samples and one run, every tenth sample 100; GPs have three draws."""
        n, learner = kind
        if learner in CANDIDATES:
            return (0,) if n == 1024 else ()
        if learner == TENTH:
            return self.seeds if n == 100 else ()
        return self.seeds[:3] if n == 400 or (n == 100 and learner in GPS) else ()

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and what a structure knows beforehand."""
        from paper.machines.tanks_systems import describe

        return {**asdict(self.settings), **describe(), "process_noise": dict(PROCESS_NOISE)}


NOISES = {"none": "none", "sensors": "sensors'"}
METHODS = {"default": "default", "map": "most likely, center 0"}
SENSORS = {
    **dict.fromkeys(("x", "theta", "theta_s", "theta_e"), 0.01),
    **dict.fromkeys(("x_dot", "theta_dot", "theta_s_dot", "theta_e_dot"), 0.05),
}
"""Standard deviations of the sensors of the states that models predict."""


@dataclass(frozen=True, kw_only=True)
class ForesightSettings:
    """Settings that decide the numbers."""

    trials: int = 7
    """real trials of an agent; dynamics learn from all but the last"""
    model_episodes: int = 10
    """episodes in the model after each of them, half as many as in the control experiments"""
    updates_per_model_step: float = 1.0
    """gradient steps for each step in the model, half as many as there"""
    horizons: tuple[int, ...] = (5, 15)
    """steps of the trajectories"""
    max_windows: int = 6
    """the most of these of a trial, evenly spread"""
    num_functions: int = 39
    """that follow them"""


@dataclass(frozen=True, kw_only=True)
class Foresight(Experiment):
    """Dynamics of the cart-pole and the arm, learnt trial by trial, predict the next trial."""

    runs: int = 5
    """agents of each system, each with a seed of its own"""
    out: Path = Path("results/foresight")
    settings: ForesightSettings = field(default_factory=ForesightSettings)

    axes: ClassVar[Axes] = {"system": {"cartpole": "cart-pole", "arm": "arm"}}
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "stable_baselines3", "opensim")

    def check(self) -> None:
        """Refuse too few trials, and a machine without OpenSim."""
        if self.settings.trials < 3:
            raise ValueError(f"--trials: expected at least 3, got {self.settings.trials}")
        self.control("arm").check()

    def describe(self, *kind: Any) -> dict[str, Any]:
        """The settings, and those of the control experiment that the agent is of."""
        agent = asdict(self.control(kind[0]).settings)
        own = asdict(self.settings)
        return {**own, "sensors": SENSORS, "agent": {k: agent[k] for k in agent if k not in own}}

    def control(self, system: str) -> Control:
        """The experiment whose system, physics and agent these are."""
        control: Control = {"cartpole": CartPole, "arm": Arm}[system]()
        own = self.settings
        settings = replace(
            control.settings,
            episodes=own.trials,
            model_episodes=own.model_episodes,
            updates_per_model_step=own.updates_per_model_step,
            last_model_episode=own.trials - 1,
        )
        return replace(control, settings=settings)


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


@dataclass(frozen=True, kw_only=True)
class KinksSettings:
    """Settings that decide the numbers."""

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
    settings: KinksSettings = field(default_factory=KinksSettings)

    axes: ClassVar[Axes] = {
        "data": {"scattered": "random states and actions", "episodes": "steps of episodes"},
        "n": {100: "100", 300: "300"},
        "system": {**KINKS, **SMOOTH},
    }
    calls: ClassVar[tuple[str, ...]] = _DYNAMICS
