"""Fitting the models, by maximum likelihood or full Bayes."""

from gpadjust.inference.calibrated_fit import ParameterWarning
from gpadjust.inference.fitting import FitOptions, fit
from gpadjust.inference.full_bayes import SampleResult, SamplingWarning
from gpadjust.inference.map_fit import FitResult
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
