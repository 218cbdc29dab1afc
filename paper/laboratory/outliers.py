"""Observations of which one in twenty is far off: what heavy tails of the noise are worth.

Four ways were tried before the first run, on seeds 100 to 107 and data of another generator.
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
from gpadjust.core import SamplingWarning
from gpadjust.kinds import HeavyTails
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import groups, markdown, number
from paper.laboratory import Outliers

_NOISE = 0.05  # of the standard deviation of the function


class Problem(NamedTuple):
    """A function and a formula of it; inputs in [0, 1]."""

    num_inputs: int
    truth: Callable[[Tensor], Tensor]
    physics: Callable[[Tensor], Tensor]


def _part(X: Tensor, i: int) -> Tensor:
    return X[:, i : i + 1]


PROBLEMS: Mapping[str, Problem] = {
    "wave": Problem(1, lambda X: 2 * (6 * X).sin() + X, lambda X: (6 * X).sin()),
    "decay": Problem(
        1, lambda X: 3 * (-2 * X).exp() + 0.5 * (4 * X).sin(), lambda X: 3 * (-2.5 * X).exp()
    ),
    "plane": Problem(
        2,
        lambda X: (3 * _part(X, 0)).sin() * (1 + _part(X, 1)) + _part(X, 1).square(),
        lambda X: (3 * _part(X, 0)).sin() * (1 + 0.6 * _part(X, 1)),
    ),
    "good": Problem(1, lambda X: (5 * X).cos(), lambda X: 1.02 * (5 * X).cos()),
    "misleading": Problem(1, lambda X: (8 * X).sin(), lambda X: X.square()),
    "space": Problem(
        3,
        lambda X: _part(X, 0) * (-_part(X, 1)).exp() + 0.5 * (5 * _part(X, 2)).sin(),
        lambda X: _part(X, 0) * (-1.3 * _part(X, 1)).exp() + 0.4 * (5 * _part(X, 2)).sin(),
    ),
}


class Case(NamedTuple):
    """Data without outliers and with them; errors are in standard deviations of the noise."""

    X: Tensor
    clean: Tensor
    dirty: Tensor
    rows: list[int]  # that are off
    test: Tensor
    truth: Tensor
    sd: Tensor


def case_of(problem: str, n: int, seed: int) -> Case:
    """One in twenty observations is off by 10 to 100 sd, uniform in the logarithm, either way."""
    draw, (d, truth, _) = np.random.default_rng([seed, n]), PROBLEMS[problem]
    X, test = (torch.from_numpy(draw.uniform(size=(k, d))) for k in (n, 400))
    f = truth(test)
    sd = _NOISE * f.std()
    clean = truth(X) + sd * torch.from_numpy(draw.normal(size=(n, 1)))
    rows = sorted(draw.choice(n, n // 20, replace=False).tolist())
    size = 10 ** draw.uniform(1, 2, len(rows)) * draw.choice([-1, 1], len(rows))
    dirty = clean.clone()
    dirty[rows] += sd * torch.from_numpy(size).unsqueeze(-1)
    return Case(X, clean, dirty, rows, test, f, sd)


def run(experiment: Outliers, problem: str, observations: int, seed: int) -> Run:
    """Fit both noises to data with and without outliers; return errors and coverage."""
    warnings.simplefilter("ignore", SamplingWarning)
    case, found = case_of(problem, observations, seed), Run()
    for data in ("clean", "dirty"):
        for noise in ("gaussian", "heavy"):
            own_noise = HeavyTails() if noise == "heavy" else None
            Y = getattr(case, data)
            model = CKA(case.X, Y, physics=PROBLEMS[problem].physics, noise=own_noise)
            begin = time.perf_counter()
            fit(model)
            seconds = time.perf_counter() - begin
            with torch.no_grad():
                error = (model.predict(case.test).mean - case.truth) / case.sd
                low, high = model.interval(case.test)
            held = (low <= case.truth) & (case.truth <= high)
            own = {"rmse": error.square().mean().sqrt().item(), "seconds": seconds}
            own["coverage"] = held.double().mean().item()
            if isinstance(model.noise, HeavyTails):
                told = (model.noise.outliers(model) > 0.5).flatten().nonzero().flatten().tolist()
                own["found"] = len({*told} & {*case.rows}) if data == "dirty" else 0
                own["wrong"] = len({*told} - ({*case.rows} if data == "dirty" else set()))
            found[f"{noise}_{data}"] = own
    return found


def tables(runs: Sequence[Run], experiment: Outliers) -> dict[str, Table]:
    """All tables, by name."""
    found = load(runs)
    header = [
        "observations",
        "problem",
        "cases",
        "Gaussian with outliers",
        "heavy tails with outliers",
    ]
    header += ["heavy tails without", "coverage with", "without", "Gaussian without"]
    header += ["outliers found", "wrongly, of 100 observations", "time"]
    rows = []
    for n, part in groups(found, "observations", experiment.axes["observations"]).items():
        every = {**groups(part, "problem", experiment.axes["problem"]), "**all**": part}
        rows += [[n, title, *_cells(own)] for title, own in every.items()]
    title = "RMSE over that of the Gaussian noise on clean data"
    return {"errors": Table(title, markdown(header, rows))}


def _cells(own: pd.DataFrame) -> list[str]:
    ratios = [number(geometric(own[name]), ".3g") for name in ("ignored", "with", "without")]
    columns = ("coverage_with", "coverage_without", "coverage_gaussian")
    shares = [number(own[name].mean(), ".2f") for name in columns]
    wrong = 100 * own["wrong"].sum() / (2 * own["observations"].sum())
    counts = [number(own["found"].sum() / own["off"].sum(), ".2f"), number(wrong, ".2g")]
    return [f"{len(own)}", *ratios, *shares, *counts, number(own["time"].median(), ".2g")]


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each case; errors are over those of the Gaussian noise on its clean data."""
    rows = []
    for r in runs:
        least = r["gaussian_clean"]["rmse"]
        rows.append(
            {
                **{key: r[key] for key in ("problem", "observations", "seed")},
                "ignored": r["gaussian_dirty"]["rmse"] / least,
                "with": r["heavy_dirty"]["rmse"] / least,
                "without": r["heavy_clean"]["rmse"] / least,
                "coverage_with": r["heavy_dirty"]["coverage"],
                "coverage_without": r["heavy_clean"]["coverage"],
                "coverage_gaussian": r["gaussian_clean"]["coverage"],
                "found": r["heavy_dirty"]["found"],
                "off": r["observations"] // 20,
                "wrong": r["heavy_dirty"]["wrong"] + r["heavy_clean"]["wrong"],
                "time": r["heavy_clean"]["seconds"] / r["gaussian_clean"]["seconds"],
            }
        )
    return pd.DataFrame(rows)


def geometric(values: pd.Series[float]) -> float:
    """The geometric mean."""
    return float(np.exp(np.log(values).mean()))


def draw(runs: Sequence[Run], experiment: Outliers) -> list[Path]:
    """Draw the first case of waves with both noises."""
    case = case_of("wave", 20, experiment.seed)
    grid = torch.linspace(0, 1, 201, dtype=torch.float64).unsqueeze(-1)
    figure, axes = panels(["Gaussian noise", "heavy tails"], 2, (4.6, 3.4))
    for ax, noise, color in zip(axes, (None, HeavyTails()), ("0.45", "#D55E00"), strict=True):
        model = CKA(case.X, case.dirty, physics=PROBLEMS["wave"].physics, noise=noise)
        fit(model)
        with torch.no_grad():
            low, high = (each.flatten() for each in model.interval(grid))
        x = grid.flatten()
        ax.fill_between(x, low, high, color=color, alpha=0.3, label="95 % interval")
        ax.plot(x, PROBLEMS["wave"].truth(grid).flatten(), color="0.2", lw=1, label="truth")
        ax.plot(case.X[:, 0], case.dirty[:, 0], ".", color="0.2", label="observations")
        if isinstance(model.noise, HeavyTails):
            told = (model.noise.outliers(model) > 0.5).flatten()
            ax.plot(
                case.X[told, 0], case.dirty[told, 0], "o", mfc="none", color=color, label="outliers"
            )
        ax.set(xlabel="input", ylabel="output")
        ax.legend(loc="best")
    return [save(figure, experiment.out / "outliers.png")]
