"""Fitting the models, by maximum likelihood or full Bayes, and choosing between them."""

from gpadjust.inference.comparison import STRUCTURES, Candidate, Comparison, compare
from gpadjust.inference.fitting import fit
from gpadjust.inference.maximisation import FitResult
from gpadjust.inference.priors import register_priors
from gpadjust.inference.sampling import SampleResult, SamplingWarning

__all__ = [
    "STRUCTURES",
    "Candidate",
    "Comparison",
    "FitResult",
    "SampleResult",
    "SamplingWarning",
    "compare",
    "fit",
    "register_priors",
]
