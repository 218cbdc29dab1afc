r"""Figures of predictions, of their coverage, and of where the physics is wrong or trusted.

Each function draws on given axes, or on those of a new figure, and returns them; show or save the
figure with ``ax.figure``. They need matplotlib, ``pip install gpadjust[plot]``. ``output`` is the
number of the output to draw, ``level`` the nominal coverage of intervals. Missing observations are
not drawn. A TypeError is of an argument of another kind, a ValueError of a wrong value or shape.

Example:
    >>> import torch
    >>> from gpadjust import CKA
    >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
    >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
    >>> plot_model(model).shape  # predictions, rho and delta
    (3, 1)
    >>> plot_prediction(model, X).get_xlabel()
    'x'
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import cycle
from textwrap import fill
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.mathtext import MathTextParser
from scipy.stats import binom
from torch import Tensor

from gpadjust.checks import (
    check_level,
    checked_bounds,
    checked_half_width,
    checked_points,
    checked_tensor,
    checked_whole,
)
from gpadjust.core.gaussian import Marginals
from gpadjust.kinds.categories import on_levels
from gpadjust.physics import PhysicsParameters, Unknown
from gpadjust.physics.unknown import Curve
from gpadjust.validation.comparison import Comparison
from gpadjust.validation.leave_one_out import LeaveOneOut
from gpadjust.validation.scores import Scores
from gpadjust.validation.trust import SIDES, Trust, physics_at
from gpadjust.validation.verdict import ALONE, CALIBRATED, name_of
from gpadjust.words import labelled

if TYPE_CHECKING:  # it needs pandas
    from gpadjust.core.priors import Priors

__all__ = [
    "plot_adjustment",
    "plot_comparison",
    "plot_coverage",
    "plot_leave_one_out",
    "plot_model",
    "plot_parameters",
    "plot_prediction",
    "plot_priors",
    "plot_trust",
]
BLUE, RED, GREY = "#0072B2", "#D55E00", "0.45"  # different for the colour-blind, too
BAND: dict[str, Any] = {"color": BLUE, "alpha": 0.2, "lw": 0}
DOTS: dict[str, Any] = {"ls": "", "marker": "o", "ms": 4.5, "mec": "white", "mew": 0.6}
_POINTS = 120  # of a curve
_STYLES = ("--", "-.", ":")  # of several physics
_COLORS = (BLUE, RED, "0.85")  # of physics, data and neither
_BINS = 10  # of each input
_DECADE = 10.0  # highest over lowest, from which axes are logarithmic
_BARS = 30  # of a histogram of draws
_COLUMNS = 4  # of panels
_LINE = 24  # characters of a label
_POSTERIOR: dict[str, Any] = {"color": BLUE, "alpha": 0.75, "fill": True, "label": "posterior"}
_PRIOR: dict[str, Any] = {"color": GREY, "lw": 1.2, "label": "prior"}


def plot_model(model: Any, *, output: int = 0, level: float = 0.95, axes: Any = None) -> Any:
    r"""Draw predictions, and :math:`\rho` and :math:`\delta` below, along each input.

    The first row has the mean, the central interval and the physics; also the data if there is one
    input. With more the curves are slices through the median of the training inputs, which are
    ticks at the bottom. The other rows are those of :func:`plot_adjustment`, if the model adjusts a
    physics.

    Returns:
        An array of axes, ``rows x d``.
    """
    names = _adjustments_of(model)
    # Of a mixture the physics is that of one of its models.
    parts = [part for part in getattr(model, "models", ()) if getattr(part, "physics", None)]
    with_physics = next(iter(parts), model)
    lines = lines_along(model, output, level)
    axes = axes_of(axes, 1 + len(names), len(lines), 2.6)
    for i, (ax, (x, X)) in enumerate(zip(axes[0], lines, strict=True)):
        with torch.no_grad():
            band(ax, x, mean_and_ends(model.marginals(X), output, level), level)
        _draw_physics(ax, x, physics_at(with_physics, X), output)
        ax.set_xlim(float(x[0]), float(x[-1]))
        tidy(ax)
        if len(lines) == 1:
            _draw_data(ax, model, output)
        else:
            _draw_ticks(ax, model, output, i)
    _share_limits(axes[0])
    axes[0, 0].set_ylabel(labels(model.data.output_names)[output])
    legend(axes[0, 0])
    if names:
        plot_adjustment(model, output=output, level=level, axes=axes[1:])
    for ax, label in zip(axes[-1], labels(model.data.input_names), strict=True):
        ax.set_xlabel(label)
    return axes


def plot_adjustment(
    model: Any,
    *,
    bounds: Tensor | None = None,
    base: Tensor | None = None,
    output: int = 0,
    level: float = 0.95,
    axes: Any = None,
) -> Any:
    r"""Draw :math:`\rho` and :math:`\delta` with their intervals: where is the physics wrong?

    One row for each that the model has (a rho for each of several physics), one column for each
    input, along which the others stay at a base point. The dashed line is the value far from data,
    for the physics as it is :math:`\rho = 1` and :math:`\delta = 0`; ticks at the bottom are the
    training inputs.

    Args:
        model: A model with ``rho`` or ``delta``.
        bounds: Range of the inputs, ``2 x d``. Default: the range of the training inputs.
        base: The base point, ``d``. Default: the median of the training inputs.
        output: The output to draw.
        level: Nominal coverage of the intervals.
        axes: Axes to draw on. Default: a new figure.

    Returns:
        An array of axes, ``rows x d``.
    """
    names = _adjustments_of(model)
    if not names:
        raise TypeError(
            "Expected a model with rho or delta to draw, such as CKA, RRA, ScaleGP and "
            f"PhysicsMeanGP; found {type(model).__name__}."
        )
    lines = lines_along(model, output, level, bounds, base)
    axes = axes_of(axes, len(names), len(lines), 2.6)
    outputs = labels(model.data.output_names)
    inputs = labels(model.data.input_names)
    suffix = ""
    if len(outputs) > 1:
        suffix = f"\nfor {outputs[output]}"
    for row, name in zip(axes, names, strict=True):
        far_from_data = next(term.mean for term in model.terms if term.name == name)
        for i, (ax, (x, X)) in enumerate(zip(row, lines, strict=True)):
            with torch.no_grad():
                drawn = mean_and_ends(model.term(name, X).marginals, output, level)
            ax.axhline(float(far_from_data), color=GREY, lw=1, ls="--")
            band(ax, x, drawn, level)
            _draw_ticks(ax, model, output, i)
            ax.set_xlim(float(x[0]), float(x[-1]))
            tidy(ax)
            if name == names[-1]:
                ax.set_xlabel(inputs[i])
        _share_limits(row)
        row[0].set_ylabel(_symbol(name) + suffix)
    axes[0, 0].legend(frameon=False)
    return axes


def plot_prediction(
    model: Any,
    X: Tensor,
    Y: Tensor | None = None,
    *,
    output: int = 0,
    level: float = 0.95,
    observation_noise: bool = False,
    ax: Axes | None = None,
) -> Axes:
    """Draw predictions of a model of one input at ``n x 1``, and true values ``n x m`` there.

    There are the mean, the central interval (of observations if ``observation_noise``), the
    training data, the physics, and the truth if ``Y`` is given.
    """
    inputs, outputs = labels(model.data.input_names), labels(model.data.output_names)
    if len(inputs) > 1:
        raise ValueError(
            f"Expected a model of one input, got {len(inputs)}; `plot_model` draws slices, and "
            "`plot_leave_one_out(leave_one_out(model))` predictions against observations."
        )
    X = checked_points("X", X, 1)
    order = X[:, 0].argsort()
    x = X[order, 0]
    with torch.no_grad():
        drawn = mean_and_ends(model.marginals(X[order], observation_noise), output, level)
    ax = axes_of(ax, 1, 1)[0, 0]
    band(ax, x, drawn, level)
    _draw_physics(ax, x, physics_at(model, X[order]), output)
    if Y is not None:
        Y = checked_tensor("Y", Y)
        if Y.shape != (len(X), len(outputs)):
            raise ValueError(
                f"Expected Y of shape {len(X)} x {len(outputs)}, a row for each of X and a column "
                f"for each output, got {tuple(Y.shape)}."
            )
        y = Y[order, output]
        ax.plot(x[~y.isnan()], y[~y.isnan()], color="black", lw=1, ls=":", label="truth")
    _draw_data(ax, model, output)
    ax.set(xlabel=inputs[0], ylabel=outputs[output])
    legend(ax)
    return ax


def plot_leave_one_out(
    loo: LeaveOneOut, *, output: int = 0, level: float = 0.95, axes: Any = None
) -> Any:
    """Draw observations over left-out predictions, and standardized residuals: on two axes."""
    if not isinstance(loo, LeaveOneOut):
        raise TypeError(
            f"Expected a LeaveOneOut, got {type(loo).__name__}; pass `leave_one_out(model)`."
        )
    z = checked_half_width(level)
    mean = column(loo.mean, output)
    residuals = column(loo.residuals, output)
    axes = axes_of(axes, 1, 2)[0]
    draw_left_out(axes[0], loo, column(loo.Y, output), output, {}, level=level)
    legend(axes[0], loc="upper left")
    axes[1].axhspan(-z, z, **BAND, label=f"{100 * level:g} %")
    axes[1].axhline(0, color=GREY, lw=1, ls="--")
    axes[1].plot(mean, residuals, color=BLUE, **DOTS)
    top = 1.35 * max(z, residuals.abs().nan_to_num().max().item())  # room for the legend
    axes[1].set(xlabel="predicted without it", ylabel="standardized residual", ylim=(-top, top))
    legend(axes[1])
    return axes


def plot_comparison(comparison: Comparison, *, output: int = 0, axes: Any = None) -> Any:
    """Draw left-out predictions by the formula and by the recommended model, and the scores.

    The first of two axes has observations over predictions. The second has the expected log
    predictive density of each structure less that of the best, with two standard errors, and its
    weight.
    """
    loo = comparison.leave_one_out()
    axes = axes_of(axes, 1, 2)[0]
    formulas = {
        name: column(predictions.mean, output)
        for name, predictions in comparison.left_out.items()
        if name.startswith((ALONE, CALIBRATED))
    }
    name = f"{comparison.chosen}, left out"
    draw_left_out(axes[0], loo, column(loo.Y, output), output, formulas, name)
    legend(axes[0])
    rows = [row for row in comparison.table[loo.output_names[output]] if not math.isnan(row.weight)]
    places = range(len(rows))
    differences = [row.elpd_diff for row in rows]
    errors = [2 * row.se_diff for row in rows]
    axes[1].errorbar(differences, places, xerr=errors, color=BLUE, **DOTS, elinewidth=1)
    axes[1].axvline(0, color=GREY, lw=1, ls="--")
    axes[1].set_yticks(places, [f"{row.structure}\nweight {row.weight:.2f}" for row in rows])
    axes[1].set(xlabel="elpd less the best, in nats", ylim=(len(rows) - 0.5, -0.5))
    tidy(axes[1])
    return axes


def plot_parameters(parameters: PhysicsParameters, *, axes: Any = None) -> Any:
    """Draw the draws of each unknown parameter of a physics, and its prior.

    A point fit is a line. An unknown function has its mean, its band of 95 %, and dotted the band
    of its prior. Return an array of axes, one for each parameter.
    """
    if not parameters:
        raise ValueError("Expected parameters to draw; the physics has no unknown ones.")
    declared = parameters.unknowns.declared
    axes = axes_of(axes, 1, len(declared), 2.6)[0]
    for ax, (name, unknown) in zip(axes, declared.items(), strict=True):
        label = labelled(labels([name])[0], unknown.unit)
        if unknown.between is None:
            _plot_density(ax, parameters[name].detach().double(), unknown)
            ax.set(xlabel=label, yticks=[], ylim=(0, 1.4 * ax.dataLim.y1))  # room for the legend
            if ax is axes[0]:
                ax.set_ylabel("density")
        else:
            _plot_curve(ax, parameters[name], unknown)
            ax.set(xlabel=unknown.function_of, ylabel=label)
        tidy(ax)
    legend(axes[0])
    return axes


def _plot_density(ax: Axes, draws: Tensor, unknown: Unknown) -> None:
    """Draw the draws of a number, and its prior."""
    low, high = draws.min(), draws.max()
    if low < high:
        style: dict[str, Any] = {"color": BLUE, "alpha": 0.75, "ec": "white"}
        ax.hist(draws.numpy(), "auto", density=True, label="posterior", **style)
        low, high = 1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low
    else:
        ax.axvline(float(low), color=BLUE, label="value")
        ends = unknown.value(torch.tensor([-3.0, 3.0]).double())
        low, high = low.minimum(ends[0]), high.maximum(ends[1])
    x = torch.linspace(float(low), float(high), _POINTS).double()
    (density,) = torch.gradient(torch.special.ndtr(unknown.coordinate(x)), spacing=(x,))
    ax.plot(x, density, color=GREY, ls="--", lw=1.2, label="prior")


def _plot_curve(ax: Axes, curve: Curve, unknown: Unknown) -> None:
    """Draw an unknown function with its band of 95 %, and the band of its prior."""
    low, high = unknown.between or (0.0, 1.0)
    x = torch.linspace(low, high, _POINTS).double()
    draws = curve(x)
    ends = draws.quantile(draws.new_tensor([0.025, 0.975]), dim=0)
    band(ax, x, [draws.mean(0), *ends], 0.95)
    half = checked_half_width(0.95)
    for end in unknown.value(torch.tensor([-half, half]).double()).tolist():
        ax.axhline(end, color=GREY, ls=":", lw=1.0)


def plot_priors(priors: Priors, *, axes: Any = None) -> Any:
    """Draw the prior of each unknown number of a model, and its posterior after a fit.

    Curves are shares of draws, on a logarithmic axis where the number spans a decade; a point fit
    is a line. Return an array of axes, one for each row of ``model.priors()``.
    """
    n = len(priors.prior)
    shape = (-(-n // _COLUMNS), min(n, _COLUMNS))  # rows are rounded up
    if axes is not None:
        shape = (1, n)
    axes = axes_of(axes, *shape, 2.4).flatten()
    posterior = priors.posterior or [draws[:0] for draws in priors.prior]
    has_several = len({*priors["output"]} - {""}) > 1
    for i, (ax, drawn, after) in enumerate(zip(axes, priors.prior, posterior, strict=False)):
        inner = drawn.quantile(drawn.new_tensor([0.01, 0.99]))
        low, high = (float(end) for end in torch.cat([inner, after[after != 0]]).aminmax())
        is_log = low > 0 and high > _DECADE * low
        edges = np.linspace(low, high, _BARS + 1)
        if is_log:
            edges = np.geomspace(low, high, _BARS + 1)
            ax.set_xscale("log")
        if len(after) == 1:
            ax.axvline(float(after), color=BLUE, label="value")
        for draws, style in ((after, _POSTERIOR), (drawn, _PRIOR)):
            if len(draws) > 1:
                counts, _ = np.histogram(draws, edges)
                ax.stairs(counts / len(draws), edges, **style)
        name = priors["name"][i]
        if has_several and priors["output"][i]:
            name = f"{name} for {priors['output'][i]}"
        ax.set(xlabel=fill(name, _LINE), yticks=[])
        tidy(ax)
    for ax in axes[n:]:
        ax.remove()
    axes[0].set_ylabel("share of draws")
    legend(axes[0])
    return axes[:n]


def plot_coverage(
    prediction: LeaveOneOut | Scores, *, output: int = 0, ax: Axes | None = None
) -> Axes:
    """Draw the observed coverage of central intervals against the nominal one.

    Below the diagonal the intervals are too narrow, above it too wide. The band covers 95 % of the
    observed coverages of as many right predictions, at each level.
    """
    scores: Any = prediction
    if isinstance(prediction, LeaveOneOut):
        scores = prediction.score()
    if not isinstance(scores, Scores):
        raise TypeError(
            f"Expected predictions with PIT values, got {type(prediction).__name__}; pass "
            "`leave_one_out(model)` of a model, or `score(posterior, Y)` of a posterior."
        )
    values = column(scores.pit, output)
    pit = values[~values.isnan()].numpy()
    axes = axes_of(ax, 1, 1, 3.6)[0, 0]
    if ax is None and len(scores.output_names) > 1:
        axes.set_title(labels(scores.output_names)[output])
    n = len(pit)
    levels = np.linspace(0, 1, 201)
    low, high = (binom.ppf(p, n, levels) / n for p in (0.025, 0.975))
    label = "95 % of right intervals"
    axes.fill_between(levels, low, high, color=GREY, alpha=0.2, lw=0, label=label)
    axes.plot([0, 1], [0, 1], color=GREY, lw=1, ls="--")
    # A central interval of level 2 |p - 1/2| is the smallest that covers a PIT value p.
    reached = [0, *np.sort(2 * abs(pit - 0.5)), 1]
    shares = [*np.arange(n + 1) / n, 1]
    axes.step(reached, shares, where="post", color=BLUE, lw=1.8, label="observed")
    axes.set(xlabel="nominal coverage", ylabel="observed coverage", aspect="equal")
    axes.set(xlim=(0, 1), ylim=(0, 1.01))
    legend(axes, loc="upper left")
    return axes


def plot_trust(trust: Trust, *, output: int = 0, axes: Any = None) -> Any:
    """Draw along each input the share of predictions that rest on physics, data, or neither.

    The shares of all points are in the legend. Return an array of ``d`` axes.
    """
    if not isinstance(trust, Trust):
        raise TypeError(f"Expected a Trust, got {type(trust).__name__}; pass `trust(model)`.")
    side = column(trust.side, output)
    axes = axes_of(axes, 1, trust.X.shape[-1])[0]
    for ax, x, name in zip(axes, trust.X.mT, labels(trust.input_names), strict=True):
        edges = np.histogram_bin_edges(x.numpy(), _BINS)
        counts = np.stack([np.histogram(x[side == i].numpy(), edges)[0] for i in range(3)])
        bottom = np.zeros(_BINS)
        for kind, color, share in zip(SIDES, _COLORS, counts / counts.sum(0).clip(1), strict=True):
            label = f"{kind}: {100 * getattr(trust, kind)[output].item():.0f} %"
            bar: dict[str, Any] = {"width": np.diff(edges), "align": "edge", "color": color}
            ax.bar(edges[:-1], share, bottom=bottom, **bar, label=label)
            bottom += share
        ax.set(xlabel=name, xlim=(edges[0], edges[-1]), ylim=(0, 1))
        tidy(ax)
    axes[0].set_ylabel("share of predictions")
    outputs = labels(trust.output_names)
    title = "rests on"
    if len(outputs) > 1:
        title = f"{outputs[output]} rests on"
    corner = (1.0, 1.0)  # outside the last axes
    legend(axes[-1], title=title, alignment="left", loc="upper left", bbox_to_anchor=corner)
    return axes


def _adjustments_of(model: Any) -> list[str]:
    """Return the names of the rhos and deltas of a model that vary, if it has a physics."""
    if not getattr(model, "physics", None):
        return []
    return [t.name for t in model.terms if t.varies and t.name not in model.data.input_names]


def _draw_physics(ax: Axes, x: Tensor, physics: Mapping[str, Tensor], output: int) -> None:
    """Draw the values ``n x m`` of each physics over a line."""
    for (name, f_p), style in zip(physics.items(), cycle(_STYLES), strict=False):
        ax.plot(x, column(f_p, output), color=GREY, ls=style, lw=1.2, label=name)


def _draw_data(ax: Axes, model: Any, output: int) -> None:
    """Draw the observations of an output over the only input."""
    y = column(model.data.Y, output)
    x = model.data.X[~y.isnan(), 0]
    ax.plot(x, y[~y.isnan()], color=RED, **DOTS, label="data")


def draw_left_out(
    ax: Axes,
    loo: LeaveOneOut,
    y: Tensor,
    output: int,
    formulas: Mapping[str, Tensor],
    name: str = "",
    level: float = 0.95,
) -> Axes:
    """Draw observations ``n`` over left-out predictions, and over values of formulas, ``n`` each.

    Axes are logarithmic where the observations span a decade.
    """
    predicted = [column(values, output) for values in (loo.mean, *loo.interval(level))]
    is_observed = ~y.isnan()
    y, mean, low, high = (values[is_observed] for values in (y, *predicted))
    values = {formula: f[is_observed] for formula, f in formulas.items()}
    drawn = torch.cat([y, mean, *values.values()])
    is_log = bool((drawn > 0).all()) and float(y.max() / y.min()) > _DECADE
    if is_log:
        low = low.maximum(1e-3 * mean)  # an axis of logarithms has no room for less
        ax.set(xscale="log", yscale="log")
    ax.plot([drawn.min(), drawn.max()], [drawn.min(), drawn.max()], color=GREY, lw=1, ls="--")
    for (formula, f), color in zip(values.items(), cycle((RED, GREY)), strict=False):
        ax.plot(f, y, **DOTS | {"mec": color, "mfc": "none", "mew": 1.0}, label=formula)
    name = name or ("corrected, left out" if formulas else "predicted, left out")
    bars = torch.stack([mean - low, high - mean]).clamp_min(0.0)
    style: dict[str, Any] = {"color": BLUE, "elinewidth": 0.8, "alpha": 0.85, **DOTS}
    ax.errorbar(mean, y, xerr=bars, label=f"{name}, {100 * level:g} %", **style)
    if is_log:  # an interval that goes far below the dots would take decades
        shown = low.maximum(0.5 * drawn.min())
        ax.set(xlim=_log_limits(torch.cat([drawn, shown, high])), ylim=_log_limits(y))
    ax.set(xlabel=f"predicted {labels(loo.output_names)[output]}", ylabel="measured")
    return ax


def _log_limits(values: Tensor) -> tuple[float, float]:
    """Return limits of a logarithmic axis around some values."""
    low, high = float(values.min()), float(values.max())
    room = (high / low) ** 0.05
    return low / room, high * room


def _draw_ticks(ax: Axes, model: Any, output: int, i: int) -> None:
    """Mark at the bottom the values of an input at which an output was observed."""
    x = model.data.X[~column(model.data.Y, output).isnan(), i]
    ax.plot(x, torch.zeros(len(x)), "|", color=RED, transform=ax.get_xaxis_transform())


def lines_along(
    model: Any, output: int = 0, level: float = 0.95, bounds: Any = None, base: Any = None
) -> list[tuple[Tensor, Tensor]]:
    """Return positions ``n`` and points ``n x d`` on a line along each input, through the base.

    Arguments are those of :func:`plot_adjustment`, which are checked.
    """
    X = model.data.X
    d = X.shape[-1]
    column(model.data.Y, output)
    check_level(level)
    if bounds is None:
        lower, upper = X.min(0).values, X.max(0).values
        # An input that never changed is drawn around its value.
        pad = torch.where(lower == upper, 0.5 * lower.abs().clamp_min(1.0), 0.0)
        bounds = torch.stack([lower - pad, upper + pad])
    bounds = checked_bounds("bounds", bounds, d).to(X)
    base = X.median(0).values if base is None else checked_tensor("base", base).to(X)
    if base.shape != (d,) or not base.isfinite().all():
        raise ValueError(f"Expected a base point of {d} inputs, finite, got {base.tolist()}.")
    lines = []
    for i in range(d):
        x = torch.linspace(bounds[0, i], bounds[1, i], _POINTS, dtype=base.dtype)
        points = base.repeat(_POINTS, 1)
        points[:, i] = x
        lines.append((x, on_levels(model, points)))
    return lines


def _symbol(name: str) -> str:
    """Return the symbols of ``rho``, ``rho_coarse`` and ``delta``."""
    symbol, _, physics = name.partition("_")
    if symbol not in ("rho", "delta"):
        return name
    return name_of(rf"$\{symbol}$", physics)


def mean_and_ends(marginals: Marginals, output: int, level: float) -> tuple[Tensor, ...]:
    """Return the mean and the ends of the interval of one output of predictions, ``n`` each."""
    ends = [marginals.quantile((1 + sign * level) / 2) for sign in (-1, 1)]
    return tuple(column(values, output) for values in (marginals.prediction.mean, *ends))


def column(values: Tensor, output: int) -> Tensor:
    """Return one output of ``n x m`` values."""
    if values.dim() != 2:
        raise ValueError(
            f"Expected n x m values to draw, got shape {tuple(values.shape)}; plot the elements of "
            "a batch one by one."
        )
    if checked_whole("output", output, 0) >= values.shape[-1]:
        raise ValueError(f"There is no output {output}; there are {values.shape[-1]}, from 0.")
    return values[:, output].detach()


def labels(names: Sequence[str]) -> list[str]:
    """Return names as labels; x1 and y2, which stand for no name, with subscripts.

    Dollars are dollars, unless they hold a formula that can be drawn.
    """
    shown = []
    for name in names:
        try:
            MathTextParser("path").parse(name.replace("\n", " "))
        except ValueError:
            name = name.replace("$", r"\$")
        shown.append(re.sub(r"^([xy])(\d+)$", r"$\1_{\2}$", name))
    return shown


def axes_of(axes: Any, rows: int, columns: int, size: float = 3.2) -> Any:
    """Return the user's axes as an array, or those of a new figure of pyplot if they are None."""
    if axes is not None:
        return given_axes(axes, (rows, columns))
    width = 1.3 * size if columns == 1 else 1.15 * size
    figure = plt.figure(figsize=(width * columns, size * rows), layout="constrained")
    return figure.subplots(rows, columns, squeeze=False)


def given_axes(axes: Any, shape: tuple[int, ...]) -> Any:
    """Return the user's axes as an array of the needed shape."""
    axes = np.asarray(axes)
    number = sum(isinstance(ax, Axes) for ax in axes.flat)
    if not number == axes.size == math.prod(shape):
        raise ValueError(f"Expected {' x '.join(map(str, shape))} axes, got {number}.")
    return axes.reshape(shape)


def band(ax: Axes, x: Tensor, drawn: Sequence[Tensor], level: float) -> None:
    """Draw a mean and the ends of its interval, ``n`` each."""
    mean, low, high = drawn
    ax.fill_between(x, low, high, **BAND, label=f"{100 * level:g} %")
    ax.plot(x, mean, color=BLUE, lw=1.8, label="mean")


def _share_limits(axes: Sequence[Axes]) -> None:
    """Give axes the same range of y: slices of one function are compared by eye."""
    low, high = zip(*(ax.get_ylim() for ax in axes), strict=True)
    for ax in axes:
        ax.set_ylim(min(low), max(high))


def legend(ax: Axes, **options: Any) -> None:
    """Add a legend and remove the frame's upper and right sides."""
    ax.legend(frameon=False, **options)
    tidy(ax)


def tidy(ax: Axes) -> None:
    """Remove the frame's upper and right sides."""
    ax.spines[["top", "right"]].set_visible(False)
