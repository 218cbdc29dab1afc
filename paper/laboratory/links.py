"""Positive and bounded outputs: is the link worth its argument, and do intervals hold?

Noise is normal in the link's units: relative, or in the logit of a share. Test points are 200 of
the same box, without noise; intervals are for the function, and for observations where they are
asked to stay within the bounds. A pump and a reactor of other forms, where intervals of the link
held 0.85 to 0.99 and 0.63 to 0.68, were replaced before the first run (seeds 1000 and 1001).
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, fit
from gpadjust.core import GP, SamplingWarning
from gpadjust.kinds import LinkedCKA, LinkedZeroMeanGP
from gpadjust.kinds.links import Link
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import markdown, number
from paper.laboratory import Links

_TEST = 200
_MEDIAN = 1e-9  # level of an interval that is the median
_COLORS = {"default": "0.45", "gp": "#E69F00", "linked": "#0072B2"}


class Problem(NamedTuple):
    """An output with bounds, and a formula for it."""

    link: str
    low: Sequence[float]  # of the inputs
    high: Sequence[float]
    system: Callable[[Tensor, np.random.Generator], Callable[[Tensor], Tensor]]
    physics: Callable[[Tensor], Tensor]
    number: int = 20
    noise: float = 0.1  # sd in the units of the link


def _rate(X: Tensor, draw: np.random.Generator) -> Callable[[Tensor], Tensor]:
    """A rate with another activation energy, which diffusion limits where it is hot."""
    energy, order, limit = draw.uniform(1.05, 1.2), draw.uniform(0.6, 0.9), draw.uniform(0.5, 2)

    def system(X: Tensor) -> Tensor:
        rate = (9.0 - 5400 * energy / X[:, :1]).exp() * X[:, 1:] ** order
        return 1 / (1 / rate + 1 / (limit * X[:, 1:]))

    return system


def _diode(X: Tensor, draw: np.random.Generator) -> Callable[[Tensor], Tensor]:
    """A diode with a leak beside it, and an ideality that formulas do not have, at 27 C."""
    ideal, leak = draw.uniform(1.05, 1.3), draw.uniform(1e-7, 1e-5)

    def system(X: Tensor) -> Tensor:
        knee = (X / (0.0259 * ideal)).expm1() * 1e-9
        return 1 / (1 / (knee + leak * X) + 20.0)

    return system


def _pump(X: Tensor, draw: np.random.Generator) -> Callable[[Tensor], Tensor]:
    """The efficiency of a pump, whose best flow moves with speed, and which leaks."""
    best, peak, leak = draw.uniform(0.5, 0.6), draw.uniform(0.75, 0.9), draw.uniform(0.02, 0.08)

    def system(X: Tensor) -> Tensor:
        q = X[:, :1] / X[:, 1:] ** 0.8
        return peak * (-((q - best) / 0.5).square()).exp() * q / (q + leak)

    return system


def _reactor(X: Tensor, draw: np.random.Generator) -> Callable[[Tensor], Tensor]:
    """Conversion by plug flow with a part that is mixed, of another rate."""
    rate, mixed = draw.uniform(0.8, 1.5), draw.uniform(0.1, 0.4)

    def system(X: Tensor) -> Tensor:
        k = rate * X[:, :1] * (2.5 * (X[:, 1:] - 1)).exp()
        return 1 - (-(1 - mixed) * k).exp() / (1 + mixed * k)

    return system


PROBLEMS: Mapping[str, Problem] = {
    "rate": Problem(
        "log", (350, 1), (600, 10), _rate, lambda X: (9.0 - 5400 / X[:, 0]).exp() * X[:, 1]
    ),
    "diode": Problem("log", (0.1,), (0.75,), _diode, lambda X: (X / 0.0259).expm1() * 1e-9),
    "pump": Problem(
        "logit", (0.05, 0.7), (1.0, 1.2), _pump, lambda X: 3.2 * X[:, 0] * (1.1 - X[:, 0])
    ),
    "reactor": Problem(
        "logit",
        (0.2, 0.8),
        (2.5, 1.3),
        _reactor,
        lambda X: 1 - 1 / (1 + X[:, 0] * (2 * (X[:, 1] - 1)).exp()),
    ),
}


def data_of(problem: Problem, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Training inputs and targets, and test inputs and values of the function."""
    draw = np.random.default_rng(seed)
    low, high = np.array(problem.low), np.array(problem.high)
    X, test = (
        torch.from_numpy(draw.uniform(low, high, (n, len(low)))) for n in (problem.number, _TEST)
    )
    system = problem.system(X, draw)
    link = Link.of(problem.link)
    noise = problem.noise * torch.from_numpy(draw.normal(size=(problem.number, 1)))
    return X, link.inverse(link.value(system(X)) + noise), test, system(test)


def model_of(name: str, problem: Problem, X: Tensor, Y: Tensor) -> GP:
    """The model of a name, before its fit."""
    if name == "gp":
        return LinkedZeroMeanGP(X, Y, link=problem.link)
    if name == "linked":
        return LinkedCKA(X, Y, physics=problem.physics, link=problem.link)
    return CKA(X, Y, physics=problem.physics)


def run(experiment: Links, problem: str, model: str, seed: int) -> Run:
    """Fit a model to a case; return its errors beside the function without noise."""
    warnings.simplefilter("ignore", SamplingWarning)
    of = PROBLEMS[problem]
    X, Y, test, truth = data_of(of, seed)
    fitted = model_of(model, of, X, Y)
    begin = time.perf_counter()
    fit(fitted)
    seconds = time.perf_counter() - begin
    link = Link.of(of.link)
    with torch.no_grad():
        lower, upper = fitted.interval(test)
        ends = fitted.interval(test, observation_noise=True)
        if of.link == "log":
            # A prediction that is not positive has no logarithm: half of the least observation.
            median = fitted.interval(test, _MEDIAN)[0].clamp_min(0.5 * Y.min())
            error = median.log() - truth.log()
        else:
            error = fitted.predict(test).mean - truth
    leaves = ~(link.holds(ends[0]) & link.holds(ends[1]))
    order = test[:, 0].argsort()[:: _TEST // 40]
    return {
        "rmse": error.square().mean().sqrt().item(),
        "coverage": ((lower <= truth) & (truth <= upper)).double().mean().item(),
        "leaves": leaves.double().mean().item(),
        "seconds": seconds,
        "shown": [each[order].flatten().tolist() for each in (test[:, :1], truth, *ends)],
        "data": [X[:, 0].tolist(), Y.flatten().tolist()],
    }


def tables(runs: Sequence[Run], experiment: Links) -> dict[str, Table]:
    """All tables, by name."""
    keys = ("problem", "model", "rmse", "coverage", "leaves", "seconds")
    found = pd.DataFrame([{key: each[key] for key in keys} for each in runs])
    rows = []
    for problem, title in experiment.axes["problem"].items():
        for model, label in experiment.axes["model"].items():
            own = found[(found["problem"] == problem) & (found["model"] == model)]
            if len(own):
                rows.append(
                    [
                        *(title, label, f"{len(own)}"),
                        number(own["rmse"].median()),
                        number(own["coverage"].mean(), ".3f"),
                        number(own["leaves"].mean(), ".2f"),
                        number(own["seconds"].median(), ".2f"),
                    ]
                )
                title = ""
    header = ["problem", "model", "cases", "median RMSE (of logarithm or share)"]
    header += ["coverage of 95 %", "share of intervals that leave the bounds", "seconds"]
    return {"links": Table("Errors and intervals", markdown(header, rows))}


def draw(runs: Sequence[Run], experiment: Links) -> list[Path]:
    """Draw the intervals of observations of the first seed, with and without the link."""
    shown = [p for p in ("diode", "reactor") if any(r["problem"] == p for r in runs)]
    if not shown:
        return []
    titles = [experiment.axes["problem"][p] for p in shown]
    figure, axes = panels(titles, len(shown), (4.6, 3.2), share=False)
    for ax, problem in zip(axes, shown, strict=True):
        for model in ("default", "linked"):
            own = [r for r in runs if r["problem"] == problem and r["model"] == model]
            if not own:
                continue
            first = min(own, key=lambda r: r["seed"])
            x, truth, lower, upper = map(np.array, first["shown"])
            label, color = experiment.axes["model"][model], _COLORS[model]
            if problem == "diode":
                lower = lower.clip(1e-10)  # a logarithmic axis ends there
            ax.vlines(x, lower, upper, color=color, lw=2, alpha=0.7, label=f"95 % of {label}")
        ax.plot(x, truth, ".", color="0.1", ms=3, label="true values")
        ax.plot(*first["data"], "x", color="#D55E00", ms=4, label="observations")
    names = {"diode": ("voltage [V]", "current [A]"), "reactor": ("residence time", "conversion")}
    for ax, problem in zip(axes, shown, strict=True):
        ax.set(xlabel=names[problem][0], ylabel=names[problem][1])
        if problem == "diode":
            ax.set_yscale("log")
        else:
            ax.axhline(1.0, color="0.2", lw=1, ls="--")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return [save(figure, experiment.out / "links.png")]
