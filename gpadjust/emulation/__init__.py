"""Simulators that are known by their runs."""

from gpadjust.emulation.emulated_physics import EmulatedPhysics

__all__ = ["EmulatedPhysics"]
