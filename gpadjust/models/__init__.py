"""The BoTorch models: the adjustments, and what they are compared with."""

from gpadjust.models.ar1 import AR1
from gpadjust.models.links import Logit
from gpadjust.models.parameters import orthogonal_rbf
from gpadjust.models.physics_parameters import PhysicsParameters
from gpadjust.models.predictive_model import Prediction, PredictiveModel
from gpadjust.models.rra import RRA
from gpadjust.models.sampled_functions import SampledFunctions
from gpadjust.models.saving import load, save
from gpadjust.models.stacked import StackedGP
from gpadjust.models.structures import (
    CKA,
    BiasGP,
    CalibratedPhysics,
    PhysicsMeanGP,
    ScaleGP,
    ZeroMeanGP,
)
from gpadjust.models.term_builder import TermBuilder
from gpadjust.models.terms_gp import TermsGP
from gpadjust.models.terms_model import TermsModel
from gpadjust.models.vanishing import vanishing_rbf
from gpadjust.models.variational_cka import VariationalCKA

__all__ = [
    "AR1",
    "CKA",
    "RRA",
    "BiasGP",
    "CalibratedPhysics",
    "Logit",
    "PhysicsMeanGP",
    "PhysicsParameters",
    "Prediction",
    "PredictiveModel",
    "SampledFunctions",
    "ScaleGP",
    "StackedGP",
    "TermBuilder",
    "TermsGP",
    "TermsModel",
    "VariationalCKA",
    "ZeroMeanGP",
    "load",
    "orthogonal_rbf",
    "save",
    "vanishing_rbf",
]
