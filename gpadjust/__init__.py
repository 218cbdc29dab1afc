"""Gaussian processes that adjust a physics model to data."""

from gpadjust.inference import FitResult, SampleResult, fit
from gpadjust.models import (
    AR1,
    CKA,
    RRA,
    BiasGP,
    PhysicsMeanGP,
    ScaleGP,
    ZeroMeanGP,
    load,
    save,
)
from gpadjust.physics import (
    BlackBoxPhysics,
    FunctionPhysics,
    JoinedPhysics,
    ODEPhysics,
    Physics,
    PhysicsError,
)
from gpadjust.validation import Comparison, compare

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
    "JoinedPhysics",
    "ODEPhysics",
    "Physics",
    "PhysicsError",
    "PhysicsMeanGP",
    "SampleResult",
    "ScaleGP",
    "ZeroMeanGP",
    "compare",
    "fit",
    "load",
    "save",
]
