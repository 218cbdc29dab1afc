"""Parameters of simulators from logs: intervals and free runs, compared with mujoco.sysid."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import ClassVar

from paper.common.experiment import Axes, Experiment


@dataclass(frozen=True, kw_only=True)
class Simulators(Experiment):
    """Parameters of MuJoCo models by their logs, by mujoco.sysid and by `identify`."""

    runs: int = 40  # logs of each machine
    seed: int = 100  # the first seed; those below, and from 1000 on, served to write the code
    rows: int = 500  # of the log, every 0.01 s
    ahead: int = 200  # rows of the free run after it
    starts: int = 1  # starts of our search; mujoco.sysid has one

    axes: ClassVar[Axes] = {
        "machine": {
            "pendulum": "pendulum",
            "arm": "arm of two links with flexible joints",
        },
        "friction": {"right": "the MJCF is right", "lacking": "the MJCF lacks dry friction"},
        "method": {
            "sysid": "mujoco.sysid",
            "sysid-told": "mujoco.sysid, with dry friction",
            "identify": "identify",
            "advised": "identify again, with the friction that its advice names",
        },
    }
    calls: ClassVar[tuple[str, ...]] = ("gpadjust.records.identify",)
    packages: ClassVar[tuple[str, ...]] = (*Experiment.packages, "mujoco")

    def check(self) -> None:
        """Raise an ImportError without mujoco.sysid, whose absence its package hides."""
        try:
            import_module("mujoco.sysid._src.optimize")
        except ImportError as error:
            raise ImportError('Run `pip install "mujoco[sysid]"`, 3.5 or newer.') from error
