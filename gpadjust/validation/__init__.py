"""Judging predictions, and choosing by them. `gpadjust.validation.plots` needs matplotlib."""

from gpadjust.validation.arviz import to_arviz
from gpadjust.validation.comparison import STRUCTURES, Comparison, Structure, compare
from gpadjust.validation.leave_one_out import LeaveOneOut, leave_one_out
from gpadjust.validation.scores import Scores, score
from gpadjust.validation.trust import Trust, trust
from gpadjust.validation.verdict import Candidate, Verdict

__all__ = [
    "leave_one_out",
    "score",
    "to_arviz",
    "trust",
]
