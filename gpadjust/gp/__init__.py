"""The GPyTorch pieces: terms of a model, and what they are made of."""

from gpadjust.gp.orthogonal_kernel import OrthogonalKernel
from gpadjust.gp.physics_columns import AppendedPhysics, PhysicsInput
from gpadjust.gp.plain_gpytorch import PhysicsMean, PhysicsScaledKernel
from gpadjust.gp.term import SumOfTerms, Term, WeightedSum
from gpadjust.gp.vanishing_kernel import VanishingKernel

__all__ = [
    "AppendedPhysics",
    "OrthogonalKernel",
    "PhysicsInput",
    "PhysicsMean",
    "PhysicsScaledKernel",
    "SumOfTerms",
    "Term",
    "VanishingKernel",
    "WeightedSum",
]
