"""Fitting the models."""

from gpadjust.inference.fitting import FitResult, fit

__all__ = ["FitResult", "fit"]
