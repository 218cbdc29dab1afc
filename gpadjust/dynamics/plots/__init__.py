"""Figures of what was measured of a machine, and of how well dynamics predict it.

Each function draws on the axes that it is given, or on those of a new figure, and returns them;
show or save the figure with ``axes.flat[0].figure``. They need matplotlib,
``pip install gpadjust[plot]``.
"""

from gpadjust.dynamics.plots.free_runs import plot_free_run
from gpadjust.dynamics.plots.records import plot_record
from gpadjust.dynamics.plots.trajectory_scores import plot_trajectory_scores

__all__ = ["plot_free_run", "plot_record", "plot_trajectory_scores"]
