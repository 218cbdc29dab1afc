"""The core: sums of Gaussian processes on a physics, with one table of unknown numbers.

Read it in this order: ``unknowns``, ``data``, ``kernels``, ``terms``, ``noise``, ``gaussian``,
``sample``, ``straight``, ``nuts``, ``fitting``, ``model``, ``structures``. What follows from these:
``posterior``, ``functions`` (samples of functions), ``summary``, ``views`` (the model for
GPyTorch), ``stacked``, ``saving``; ``fourier`` and ``gpytorch_kernels`` are kernels.
"""

from gpadjust.core.data import Data
from gpadjust.core.fitting import FitResult, SamplingWarning, fit
from gpadjust.core.fourier import Fourier
from gpadjust.core.functions import Functions
from gpadjust.core.gaussian import Marginals, Prediction
from gpadjust.core.gpytorch_kernels import OfGPyTorch
from gpadjust.core.kernels import MATERN12, MATERN32, MATERN52, RBF, Kernel, Profile, Stationary
from gpadjust.core.model import GP, Predictive
from gpadjust.core.noise import KnownNoise, Noise
from gpadjust.core.posterior import MixturePosterior
from gpadjust.core.saving import load, save
from gpadjust.core.stacked import StackedGP
from gpadjust.core.structures import (
    CKA,
    RRA,
    CalibratedPhysics,
    PhysicsMeanGP,
    ScaleGP,
    ZeroMeanGP,
)
from gpadjust.core.terms import Term
from gpadjust.core.unknowns import Choice, LogNormal, Row

__all__ = [
    "GP", "MATERN52", "Choice", "Kernel", "LogNormal", "Noise", "OfGPyTorch", "Prediction",
    "Profile", "Row", "SamplingWarning", "Stationary", "Term",
]  # fmt: skip
