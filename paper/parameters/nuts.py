"""Draws of the default fit, of NUTS and the most likely numbers on five data sets.

Models of nested ones are compared without these: NUTS draws from the density of the whole model.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import gaussian_kde

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, fit
from gpadjust.core import GP
from gpadjust.core.summary import numbers_of
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import markdown, number
from paper.functions.problems import PROBLEMS
from paper.parameters import Nuts
from paper.parameters.laws import case, textbook_case
from paper.published.nist import model_of

LEVELS = [(i + 0.5) / 60 for i in range(60)]
SHOWN = {
    "wave": ("delta lengthscale of x", "noise standard deviation"),
    "forrester": ("rho standard deviation of the constant", "delta lengthscale of x"),
    "ball": ("gravity", "delta standard deviation"),
    "enzyme": ("K", "Ki"),
    "Thurber": ("b2", "b7"),
}
"""Numbers whose densities are drawn."""
_COLOURS = {"bayes": "navy", "nuts": "tab:orange", "map": "0.5"}


def model_for(problem: str) -> GP:
    """Make the model of a problem and its data."""
    if problem == "wave":
        X = torch.linspace(0, 3, 18, dtype=torch.float64).unsqueeze(-1)
        noise = torch.randn(X.shape, generator=torch.Generator().manual_seed(0), dtype=X.dtype)
        Y = 1.2 * (2 * X).sin() + 0.3 * X + 0.05 * noise
        return CKA(X, Y, physics=lambda X: (2 * X).sin(), nested=False)
    if problem == "forrester":
        X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        Y = PROBLEMS["forrester"].truth(X)
        return CKA(X, Y, physics=PROBLEMS["forrester"].physics, nested=False)
    if problem == "Thurber":
        return model_of(problem, 2)
    known = textbook_case("ball", 0) if problem == "ball" else case("inhibitor", 0)
    structure = PhysicsMeanGP if problem == "ball" else CalibratedPhysics
    return structure(known.X, known.Y, physics=known.physics)


def run(experiment: Nuts, problem: str, method: str, seed: int) -> Run:
    """Fit a model; return quantiles of all numbers, and bands along the first input."""
    model, begin = model_for(problem), time.perf_counter()
    draws = experiment.num_draws if method == "nuts" else None
    result = fit(model, method, num_draws=draws, seed=seed)
    seconds = time.perf_counter() - begin
    levels = torch.tensor(LEVELS, dtype=torch.float64)
    with torch.no_grad():
        numbers = {
            name: each.draws.quantile(levels).tolist()
            for (_, name), each in numbers_of(model, model.draws).items()
        }
    X = model.data.X
    low, high = X.min(0).values, X.max(0).values
    X = low + torch.linspace(0, 1, 41, dtype=X.dtype).unsqueeze(-1) * (high - low)
    lower, upper = (each.flatten().tolist() for each in model.interval(X))
    return {
        "numbers": {name: [float(f"{v:.4g}") for v in values] for name, values in numbers.items()},
        "X": X[:, 0].tolist(),
        "mean": model.predict(X).mean.flatten().tolist(),
        "lower": lower,
        "upper": upper,
        "rhat": result.rhat,
        "seconds": seconds,
    }


def tables(runs: Sequence[Run], experiment: Nuts) -> dict[str, Table]:
    """Return all tables, by name."""
    rows = []
    for problem, label in experiment.axes["problem"].items():
        own = [run for run in runs if run["problem"] == problem]
        for method, text in experiment.axes["method"].items():
            cells = _beside(own, method)
            if cells:
                rows.append([label if method == "bayes" else "", text, *cells])
    header = ["", "fit", "medians, off by", "widths of intervals", "means, off by"]
    text = markdown([*header, "widths of bands", "R-hat", "seconds"], rows)
    return {"summary": Table("Beside NUTS, in its standard deviations and widths", text)}


def _beside(runs: Sequence[Run], method: str) -> list[str]:
    """Return the cells of a method; of NUTS, its second seed compared with its first."""
    by_nuts = [run for run in runs if run["method"] == "nuts"]
    reference = min(by_nuts, key=lambda run: run["seed"], default={})
    own = [run for run in runs if run["method"] == method]
    others = [run for run in own if run is not reference]
    if not reference or not others:
        return []
    off, wide, mean_off, band = [], [], [], []
    low, high = np.array(reference["lower"]), np.array(reference["upper"])
    for run in others:
        for name, values in reference["numbers"].items():
            ours, theirs = np.array(run["numbers"][name]), np.array(values)
            if theirs.min() > 0:  # sizes, which are known to factors
                ours, theirs = np.log(ours), np.log(theirs)
            off.append(abs(np.median(ours) - np.median(theirs)) / max(theirs.std(), 1e-12))
            wide.append((ours[-2] - ours[1]) / max(theirs[-2] - theirs[1], 1e-12))
        gap = (np.array(run["mean"]) - reference["mean"]) / (high - low) * 2 * 1.96
        mean_off.append(np.sqrt(np.mean(gap**2)))
        band.append(np.mean((np.array(run["upper"]) - run["lower"]) / (high - low)))
    rhats = [run["rhat"] for run in own if run["rhat"] is not None]
    return [
        f"{max(off):.2f}",
        f"{min(wide):.2f} to {max(wide):.2f}" if max(wide) else "0",
        f"{np.mean(mean_off):.2f}",
        f"{np.mean(band):.2f}",
        number(max(rhats, default=None), ".2f"),
        f"{np.mean([run['seconds'] for run in own]):.1f}",
    ]


def draw(runs: Sequence[Run], experiment: Nuts) -> list[Path]:
    """Draw densities of two numbers and the bands of each problem."""
    problems = [p for p in experiment.axes["problem"] if any(r["problem"] == p for r in runs)]
    figure, axes = panels([""] * (3 * len(problems)), 3, (3.3, 2.2), share=False)
    for i, problem in enumerate(problems):
        own = [run for run in runs if run["problem"] == problem]
        row = axes[3 * i : 3 * i + 3]
        row[0].set_title(experiment.axes["problem"][problem], fontsize=8, loc="left")
        for ax, name in zip(row, SHOWN[problem], strict=False):
            every = np.concatenate([run["numbers"][name] for run in own])
            is_size = every.min() > 0 and every.max() > 5 * every.min()
            for run in own:
                values = np.array(run["numbers"][name])
                _density(ax, np.log10(values) if is_size else values, _COLOURS[run["method"]])
            ax.set_xlabel(f"log10 {name}" if is_size else name, fontsize=7)
            ax.set_yticks([])
        middle = np.mean([run["mean"] for run in own if run["method"] == "nuts"], axis=0)
        for run in own:
            is_first = run["seed"] == own[0]["seed"]
            label = experiment.axes["method"][run["method"]] if is_first else None
            for end in ("lower", "upper"):
                y = np.array(run[end]) - middle
                row[2].plot(run["X"], y, color=_COLOURS[run["method"]], lw=1, label=label)
                label = None
        row[2].set_title("95 % bands less the mean of NUTS", fontsize=8, loc="left")
    axes[2].legend(fontsize=7)
    return [save(figure, experiment.folder / "nuts.png")]


def _density(ax: Any, x: np.ndarray, colour: str) -> None:
    """Draw a density by its quantiles; a line where there is a single value."""
    if np.ptp(x) < 1e-9:
        ax.axvline(x[0], color=colour, lw=1, ls=":")
    else:
        grid = np.linspace(x.min() - 0.2 * np.ptp(x), x.max() + 0.2 * np.ptp(x), 200)
        ax.plot(grid, gaussian_kde(x)(grid), color=colour, lw=1)
