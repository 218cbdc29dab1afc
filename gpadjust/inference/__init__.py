"""Fitting the models, by maximum likelihood or full Bayes, and choosing between them."""

from gpadjust.inference.comparison import STRUCTURES, Candidate, Comparison, Structure, compare
from gpadjust.inference.fitting import FitOptions, fit
from gpadjust.inference.full_bayes import SampleResult, SamplingWarning
from gpadjust.inference.map_fit import FitResult
from gpadjust.inference.priors import register_priors

__all__ = [
    "STRUCTURES",
    "Candidate",
    "Comparison",
    "FitOptions",
    "FitResult",
    "SampleResult",
    "SamplingWarning",
    "Structure",
    "compare",
    "fit",
    "register_priors",
]
