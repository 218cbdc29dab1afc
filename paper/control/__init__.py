"""Controllers for machines as they are: systems that people know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from paper.common.experiment import Axes, Experiment
from paper.common.learners import labels

HORIZONS = {"pendulum": 12, "furuta": 10, "quadrotor": 12, "double_pendulum": 12, "tanks": 8}
"""Steps that are planned ahead at each step, by the name of a known system."""


@dataclass(frozen=True, kw_only=True)
class Known(Experiment):
    """Systems that people know, with rivals on the same trials.

    Settings were found with the true systems and seeds of 20 and more.
    """

    runs: int = 5
    trials: int = 3
    """real trials of a run, of which the first goes by f_p, or is random where there is none"""
    sequences: int = 128  # that are planned at each step, in each round of the cross-entropy method
    rounds: int = 0  # of these after the first
    first_sequences: int = 128  # that are planned when a trial begins, of all its steps
    first_rounds: int = 2  # of these after the first
    elites: int = 12  # of a round
    spread: float = 0.15
    """of the sequences about the earlier plan, in shares of the range of the actions"""
    fit: Literal["map", "bayes"] = "map"
    """of the learnt models; "bayes", the default of the library, takes twice as long"""
    networks: int = 5  # of an ensemble
    training: int = 250  # steps of Adam after each trial, of these

    axes: ClassVar[Axes] = {
        "system": {
            "pendulum": "Pendulum-v1",
            "furuta": "Furuta pendulum",
            "quadrotor": "quadrotor",
            "double_pendulum": "pendubot",
            "tanks": "two tanks",
        },
        "learner": labels("cka", "phymean", "phy", "fitted", "gp")
        | {"ensemble": "f_p and an ensemble of networks"}
        | labels("oracle"),
    }
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "gymnasium")
    calls: ClassVar[tuple[str, ...]] = (
        "gpadjust.dynamics.LearnedDynamics",
        "gpadjust.control.Planner",
    )
    cheap: ClassVar[Mapping[str, Any]] = {"trials": 1}

    def describe(self, *kind: Any) -> dict[str, Any]:
        """Return the settings, and how far plans look."""
        return {**self.settings, "horizon": HORIZONS[kind[0]]}


@dataclass(frozen=True, kw_only=True)
class First(Experiment):
    """The first trials of cart-poles, by the library's defaults; found with seeds of 100 on."""

    runs: int = 20
    trials: int = 5  # real trials of a run, of which the first goes by f_p

    axes: ClassVar[Axes] = {"model": {"cka": "CKA", "truth": "the true system"}}
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "gymnasium")
    calls: ClassVar[tuple[str, ...]] = (*Known.calls, "gpadjust.control.MPC")
    cheap: ClassVar[Mapping[str, Any]] = {"trials": 1}
