"""Fitting the models, by maximum likelihood or full Bayes."""

from gpadjust.inference.bayes import SampleResult, SamplingWarning
from gpadjust.inference.calibrate import ParameterWarning
from gpadjust.inference.fitting import FitOptions, fit
from gpadjust.inference.optimise import FitResult
from gpadjust.inference.priors import register_priors

__all__ = [
    "FitOptions",
    "FitResult",
    "ParameterWarning",
    "SampleResult",
    "SamplingWarning",
    "fit",
    "register_priors",
]
