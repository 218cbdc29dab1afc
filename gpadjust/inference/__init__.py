"""Fitting the models."""

from gpadjust.inference.fit import FitResult, fit

__all__ = ["FitResult", "fit"]
