"""The BoTorch models: the adjustments, and what they are compared with."""

from gpadjust.models.adjusted_gp import AdjustedGP, Adjustment
from gpadjust.models.ar1 import AR1
from gpadjust.models.baselines import BiasGP, PhysicsMeanGP, ScaleGP, ZeroMeanGP
from gpadjust.models.calibrated_physics import CalibratedPhysics
from gpadjust.models.cka import CKA
from gpadjust.models.exact_gp_base import ExactGPBase, Prediction
from gpadjust.models.hyperparameters import orthogonal_rbf
from gpadjust.models.physics_parameters import PhysicsParameters
from gpadjust.models.rra import RRA, PaperRRA
from gpadjust.models.sampled_functions import SampledFunctions
from gpadjust.models.saving import load, save
from gpadjust.models.stacked import StackedGP

__all__ = [
    "AR1",
    "CKA",
    "RRA",
    "AdjustedGP",
    "Adjustment",
    "BiasGP",
    "CalibratedPhysics",
    "ExactGPBase",
    "PaperRRA",
    "PhysicsMeanGP",
    "PhysicsParameters",
    "Prediction",
    "SampledFunctions",
    "ScaleGP",
    "StackedGP",
    "ZeroMeanGP",
    "load",
    "orthogonal_rbf",
    "save",
]
