"""Gaussian processes that adjust a physics model to data."""

from gpadjust.inference import Comparison, FitResult, SampleResult, compare, fit
from gpadjust.models import (
    AR1,
    CKA,
    RRA,
    BiasGP,
    PhysicsMeanGP,
    ScaleGP,
    ZeroMeanGP,
)
from gpadjust.physics import BlackBoxPhysics, FunctionPhysics, ODEPhysics, Physics, PhysicsError

__version__ = "0.1.0"

__all__ = [
    "AR1",
    "CKA",
    "RRA",
    "BiasGP",
    "BlackBoxPhysics",
    "Comparison",
    "FitResult",
    "FunctionPhysics",
    "ODEPhysics",
    "Physics",
    "PhysicsError",
    "PhysicsMeanGP",
    "SampleResult",
    "ScaleGP",
    "ZeroMeanGP",
    "compare",
    "fit",
]
