"""The GPyTorch pieces: means, kernels and transforms that read the physics."""

from gpadjust.gp.adjusted_mean import AdjustedMean
from gpadjust.gp.angle_input import AngleInput
from gpadjust.gp.fixed_standardize import FixedStandardize, RescaledPosterior
from gpadjust.gp.fourier import FourierFeatures, FourierKernel
from gpadjust.gp.inputs_kernel import InputsKernel
from gpadjust.gp.log_interval import DataInterval, LogInterval
from gpadjust.gp.physics_input import PhysicsInput
from gpadjust.gp.physics_mean import PhysicsMean
from gpadjust.gp.physics_scaled_kernel import PhysicsScaledKernel
from gpadjust.gp.readers import PhysicsColumn, PhysicsOutput
from gpadjust.gp.unknown_mean_kernel import UnknownMeanKernel

__all__ = [
    "AdjustedMean",
    "AngleInput",
    "DataInterval",
    "FixedStandardize",
    "FourierFeatures",
    "FourierKernel",
    "InputsKernel",
    "LogInterval",
    "PhysicsColumn",
    "PhysicsInput",
    "PhysicsMean",
    "PhysicsOutput",
    "PhysicsScaledKernel",
    "RescaledPosterior",
    "UnknownMeanKernel",
]
