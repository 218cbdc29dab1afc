"""Fitted models and dynamics without Python: C, and functions of CasADi (the extra ``export``)."""

from gpadjust.export.c_program import c_source
from gpadjust.export.casadi_program import casadi_function

__all__ = ["c_source", "casadi_function"]
