"""The BoTorch models: the adjustments, and what they are compared with."""

from gpadjust.models.adjusted_gp import AdjustedGP, Adjustment
from gpadjust.models.adjusted_model import AdjustedModel
from gpadjust.models.ar1 import AR1
from gpadjust.models.baselines import BiasGP, PhysicsMeanGP, ScaleGP, ZeroMeanGP
from gpadjust.models.calibrated_physics import CalibratedPhysics
from gpadjust.models.cka import CKA
from gpadjust.models.exact_gp_base import ExactGPBase
from gpadjust.models.hyperparameters import orthogonal_rbf
from gpadjust.models.physics_parameters import PhysicsParameters
from gpadjust.models.rra import RRA, PaperRRA
from gpadjust.models.sampled_functions import SampledFunctions
from gpadjust.models.saving import load, save
from gpadjust.models.stacked import StackedGP
from gpadjust.models.terms_model import Prediction, TermsModel
from gpadjust.models.variational_cka import VariationalCKA

__all__ = [
    "AR1",
    "CKA",
    "RRA",
    "AdjustedGP",
    "AdjustedModel",
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
    "TermsModel",
    "VariationalCKA",
    "ZeroMeanGP",
    "load",
    "orthogonal_rbf",
    "save",
]
