"""Noise that grows with the output, over three decades: do intervals hold in each of them?"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, ZeroMeanGP, fit
from gpadjust.core import GP, SamplingWarning
from gpadjust.kinds import RelativeNoise
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import markdown, number
from paper.laboratory import Relative

_DECADES = ("lowest", "middle", "highest")
_NOISE = 0.05  # of the output, and a fiftieth of the least output beside it
_COLORS = {"default": "0.45", "relative": "#D55E00"}


class Problem(NamedTuple):
    """A function over three decades, up to about 1, and a formula of it; inputs in [0, 1]."""

    num_inputs: int
    truth: Callable[[Tensor], Tensor]
    physics: Callable[[Tensor], Tensor]


def _grows(X: Tensor) -> Tensor:
    """Three decades along the first input."""
    return (math.log(1e3) * (X[..., :1] - 1)).exp()


PROBLEMS: Mapping[str, Problem] = {
    "rate": Problem(1, lambda X: _grows(X) * (1 + 0.3 * (5 * X[:, :1]).sin()), _grows),
    "power": Problem(
        1,
        lambda X: (0.1 + 0.9 * X[:, :1]) ** 3 * (0.7 + 0.3 * X[:, :1]),
        lambda X: (0.1 + 0.9 * X[:, :1]) ** 2.8,
    ),
    "plane": Problem(2, lambda X: _grows(X) * (0.6 + 0.4 * X[:, 1:2].square()), _grows),
}


def data(problem: str, seed: int, n: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Training inputs and targets, test inputs, the function there, and new observations."""
    draw, (d, truth, _) = np.random.default_rng(seed), PROBLEMS[problem]
    X, test = (torch.from_numpy(draw.uniform(size=(k, d))) for k in (n, 600))
    values = [truth(each) for each in (X, test)]
    noisy = [f + torch.from_numpy(draw.normal(size=f.shape)) * (_NOISE * f + 2e-5) for f in values]
    return X, noisy[0], test, values[1], noisy[1]


def model_of(structure: str, kind: str, X: Tensor, Y: Tensor, problem: str) -> GP:
    """A model before its fit."""
    noise = RelativeNoise() if kind == "relative" else None
    if structure == "CKA":
        return CKA(X, Y, physics=PROBLEMS[problem].physics, noise=noise)
    return ZeroMeanGP(X, Y, noise=noise)


def run(experiment: Relative, problem: str, structure: str, noise: str, seed: int) -> Run:
    """Fit a model; return its errors and coverage in each decade of the output."""
    warnings.simplefilter("ignore", SamplingWarning)
    X, Y, test, f, new = data(problem, seed, experiment.observations)
    model = model_of(structure, noise, X, Y, problem)
    begin = time.perf_counter()
    fit(model)
    seconds = time.perf_counter() - begin
    with torch.no_grad():
        mean = model.predict(test).mean
        held = [
            ((low <= y) & (y <= high)).double()
            for (low, high), y in (
                (model.interval(test, observation_noise=noisy), y)
                for noisy, y in ((False, f), (True, new))
            )
        ]
    decade = (f.log10() + 3).floor().clamp(0, 2)
    found: Run = {"seconds": seconds}
    for i, name in enumerate(_DECADES):
        own = decade == i
        found[name] = {
            "error": ((mean - f) / f)[own].square().mean().sqrt().item(),
            "function": held[0][own].mean().item(),
            "observations": held[1][own].mean().item(),
        }
    return found


def tables(runs: Sequence[Run], experiment: Relative) -> dict[str, Table]:
    """All tables, by name."""
    found = load(runs)
    rows = []
    for structure, of in experiment.axes["structure"].items():
        for noise, label in experiment.axes["noise"].items():
            own = found[(found["structure"] == structure) & (found["noise"] == noise)]
            if len(own):
                cells = [
                    number(own[own["decade"] == decade][what].mean(), ".2f")
                    for what in ("observations", "function")
                    for decade in _DECADES
                ]
                errors = own.groupby("decade")["error"].apply(_geometric)
                cells += [f"{100 * errors[decade]:.1f}" for decade in _DECADES]
                rows.append([of, label, *cells, number(own["seconds"].median(), ".2f")])
    header = ["model", "noise"]
    header += [f"observations held, {decade} decade" for decade in _DECADES]
    header += [f"function held, {decade}" for decade in _DECADES]
    header += [f"relative error in %, {decade}" for decade in _DECADES] + ["seconds"]
    return {"decades": Table("Coverage of 95 % and errors by decade", markdown(header, rows))}


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each run and decade."""
    keys = ("problem", "structure", "noise", "seed", "seconds")
    rows: list[dict[str, Any]] = []
    for each in runs:
        rows += [{**{k: each[k] for k in keys}, "decade": d, **each[d]} for d in _DECADES]
    return pd.DataFrame(rows)


def _geometric(values: pd.Series[float]) -> float:
    return float(np.exp(np.log(values).mean()))


def draw(runs: Sequence[Run], experiment: Relative) -> list[Path]:
    """Draw intervals of the first seed, on a logarithmic axis."""
    X, Y, *_ = data("rate", experiment.seed, experiment.observations)
    grid = torch.linspace(0, 1, 201, dtype=torch.float64).unsqueeze(-1)
    truth = PROBLEMS["rate"].truth(grid)
    figure, axes = panels(["noise of one size", "relative noise"], 2, (4.6, 3.4))
    for ax, noise in zip(axes, experiment.axes["noise"], strict=True):
        model = model_of("CKA", noise, X, Y, "rate")
        fit(model)
        with torch.no_grad():
            low, high = (e.flatten() for e in model.interval(grid, observation_noise=True))
        x, color = grid.flatten(), _COLORS[noise]
        ax.fill_between(x, low.clamp_min(1e-6), high, color=color, alpha=0.3, label="95 % interval")
        ax.plot(x, truth.flatten(), color="0.2", lw=1, label="truth")
        ax.plot(X[:, 0], Y[:, 0], ".", color=color, label="observations")
        ax.set(yscale="log", ylim=(2e-4, 3), xlabel="input", ylabel="output")
        ax.legend(loc="lower right")
    return [save(figure, experiment.out / "relative.png")]
