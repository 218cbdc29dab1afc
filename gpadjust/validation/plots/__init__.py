"""Figures of predictions, of their coverage, and of where the physics is wrong or trusted.

Each function draws on the axes that it is given, or on those of a new figure, and returns them;
show or save the figure with ``ax.figure``. They need matplotlib, ``pip install gpadjust[plot]``.
"""

from gpadjust.validation.plots.adjustments import plot_adjustment, plot_trust
from gpadjust.validation.plots.overview import plot_model
from gpadjust.validation.plots.predictions import (
    plot_coverage,
    plot_leave_one_out,
    plot_prediction,
)

__all__ = [
    "plot_adjustment",
    "plot_coverage",
    "plot_leave_one_out",
    "plot_model",
    "plot_prediction",
    "plot_trust",
]
