"""Fitted models and dynamics without Python: C, FMUs, and CasADi (the extra ``export``)."""

from gpadjust.export.c_program import c_source
from gpadjust.export.casadi_program import casadi_function
from gpadjust.export.fmu import export_fmu

__all__ = ["c_source", "casadi_function", "export_fmu"]
