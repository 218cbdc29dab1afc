"""Figures of the scores of trajectories."""

from __future__ import annotations

from typing import Any

from scipy.stats import binom

from gpadjust.dynamics.trajectory_scores import LEVEL, TrajectoryScores
from gpadjust.validation.plots.drawing import BLUE, GREY, given_axes, new_axes, tidy


def plot_trajectory_scores(scores: TrajectoryScores, *, axes: Any = None) -> Any:
    """Draw the calibration of k-step predictions over k: coverage of each state, and energy score.

    The dashed line is the nominal coverage; the band holds 95 % of the coverages of calibrated
    predictions from as many independent windows. Those of a few episodes overlap and scatter more.
    States of which the dynamics say no variance are not in the first figure.

    Args:
        scores: What :meth:`~gpadjust.dynamics.Dynamics.score_trajectories` returned.
        axes: Two axes to draw on. Default: a new figure.

    Returns:
        An array of two axes.

    Raises:
        TypeError: If ``scores`` are something else, as dynamics.
        ValueError: If no horizon has a window, or ``axes`` are not two.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import PhysicsDynamics, StateSpec
        >>> dynamics = PhysicsDynamics(StateSpec(["x"], ["v"]), lambda X: X[:, :1] + 0.1 * X[:, 1:])
        >>> x = torch.arange(9, dtype=torch.float64).unsqueeze(-1)
        >>> scores = dynamics.score_trajectories(x[:-1], torch.ones_like(x[1:]), x[1:])
        >>> plot_trajectory_scores(scores).shape
        (2,)
    """
    if not isinstance(scores, TrajectoryScores):
        raise TypeError(
            f"Expected TrajectoryScores, got {type(scores).__name__}; pass "
            "`dynamics.score_trajectories(states, actions, next_states)`."
        )
    has = scores.num_windows > 0
    if not has.any():
        raise ValueError(
            f"No episode has as many steps as any of the horizons {scores.horizons}; score shorter "
            "ones."
        )
    axes = new_axes(1, 2)[0] if axes is None else given_axes(axes, (2,))
    steps = [k for k, some in zip(scores.horizons, has, strict=True) if some]
    low, high = (binom.ppf(p, scores.num_windows[has], LEVEL) for p in (0.025, 0.975))
    num = scores.num_windows[has].numpy()
    axes[0].fill_between(
        steps, low / num, high / num, color=GREY, alpha=0.2, lw=0, label="95 % if calibrated"
    )
    axes[0].axhline(LEVEL, color=GREY, lw=1, ls="--")
    for name, values in zip(scores.states, scores.coverage[has].T, strict=True):
        if not values.isnan().all():
            axes[0].plot(steps, values, "o-", ms=4.5, lw=1.5, label=name)
    axes[0].set(ylabel="coverage of 95 % intervals", ylim=(-0.02, 1.02))
    axes[0].legend(frameon=False, loc="lower right", fontsize="small")
    axes[1].plot(steps, scores.energy[has], "o-", color=BLUE, ms=4.5, lw=1.5)
    axes[1].set(ylabel="energy score, in typical steps")
    axes[1].set_ylim(0, 1.1 * float(scores.energy[has].max()) or None)
    for ax in axes:
        ax.set(xlabel="steps ahead", xticks=steps)
        tidy(ax)
    return axes
