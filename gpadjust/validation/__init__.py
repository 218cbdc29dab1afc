"""Judging predictions."""

from gpadjust.validation.scores import coverage, crps, nlpd, rmse

__all__ = ["coverage", "crps", "nlpd", "rmse"]
