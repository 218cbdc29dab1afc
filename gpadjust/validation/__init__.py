"""Judging predictions, and choosing by them. `gpadjust.validation.plots` needs matplotlib."""

from gpadjust.validation.advice import Gain
from gpadjust.validation.arviz import to_arviz
from gpadjust.validation.comparison import Comparison, compare
from gpadjust.validation.leave_one_out import LeaveOneOut, leave_one_out
from gpadjust.validation.ranking import Candidate
from gpadjust.validation.scores import Scores, coverage, crps, nlpd, pit, rmse, score
from gpadjust.validation.structures import STRUCTURES, Structure
from gpadjust.validation.trust import Trust, trust

__all__ = [
    "STRUCTURES",
    "Candidate",
    "Comparison",
    "Gain",
    "LeaveOneOut",
    "Scores",
    "Structure",
    "Trust",
    "compare",
    "coverage",
    "crps",
    "leave_one_out",
    "nlpd",
    "pit",
    "rmse",
    "score",
    "to_arviz",
    "trust",
]
