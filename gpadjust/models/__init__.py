"""The BoTorch models: the adjustments, and what they are compared with."""

from gpadjust.gp import feature_maps as _feature_maps  # noqa: F401, registers them
from gpadjust.models import ar1_features as _ar1_features  # noqa: F401
from gpadjust.models.adjusted_functions import AdjustedFunctions
from gpadjust.models.adjustment_gp import AdjustmentGP
from gpadjust.models.ar1 import AR1, AR1Kernel
from gpadjust.models.baselines import BiasGP, PhysicsMeanGP, ScaleGP, ZeroMeanGP
from gpadjust.models.cka import CKA
from gpadjust.models.prediction import Prediction
from gpadjust.models.rra import RRA

__all__ = [
    "AR1",
    "CKA",
    "RRA",
    "AR1Kernel",
    "AdjustedFunctions",
    "AdjustmentGP",
    "BiasGP",
    "PhysicsMeanGP",
    "Prediction",
    "ScaleGP",
    "ZeroMeanGP",
]
