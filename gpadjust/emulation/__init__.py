"""Simulators that are known by their runs."""

from gpadjust.emulation.emulated_physics import EmulatedPhysics
from gpadjust.emulation.next_runs import next_runs

__all__ = ["EmulatedPhysics", "next_runs"]
