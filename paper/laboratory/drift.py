"""Half a year of a pump that wears, predicted a step of two hours ahead.

What is fitted again: a CKA of the last week, to its most likely hyper-parameters, each day; between
it is updated at each step. Intervals with the noise of the first fit hold 0.89 on seeds 900 and
901, so that variances follow recent errors.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gpadjust import CKA, RRA, fit
from gpadjust.kinds import Kalman, Window
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import markdown, number
from paper.laboratory import Drift
from paper.laboratory.pumps import Wear, catalogue

_COLORS = {"never": "0.6", "rra": "tab:green", "cka": "navy", "refit": "tab:orange"}


def run(experiment: Drift, model: str, seed: int) -> Run:
    """Errors of the head a step ahead, and whether intervals of 95 % hold what is measured."""
    settings = experiment.settings
    pump, first = Wear(settings.steps, seed, wears=model != "steady"), settings.first
    X, Y = pump.X, pump.Y

    def built(end: int) -> Any:
        start = max(0, end - (settings.refit_window if model == "refit" else end))
        rows = slice(start, end)
        if model in ("rra", "steady"):
            rra = RRA(X[rows], Y[rows], physics=catalogue, num_features=settings.num_features)
            fit(rra, settings.method)
            return Kalman(rra, settings.forget)
        cka = CKA(X[rows], Y[rows], physics=catalogue)
        fit(cka, settings.method)
        if model == "never":
            return cka
        return Window(cka, settings.refit_window if model == "refit" else settings.window)

    begin = time.perf_counter()
    adjusted = built(first)
    means, held = [], []
    if model == "never":
        mean, _ = adjusted.predict(X[first:])
        low, high = adjusted.interval(X[first:], observation_noise=True)
        means = mean.flatten().tolist()
        held = ((low <= Y[first:]) & (Y[first:] <= high)).flatten().tolist()
    for i in range(first, settings.steps if model != "never" else first):
        x, y = X[i : i + 1], Y[i : i + 1]
        if model == "refit" and (i - first) % settings.refit_every == 0 and i > first:
            adjusted = built(i)
        means.append(adjusted.predict(x).mean.item())
        low, high = adjusted.interval(x, observation_noise=True)
        held.append(bool(low <= y <= high))
        adjusted.update(x, y)
    errors = torch.tensor(means, dtype=torch.float64) - pump.truth[first:].flatten()
    week = errors.square().split(84)
    return {
        "rmse": errors.square().mean().sqrt().item(),
        "coverage": float(np.mean(held)),
        "rmse_of_weeks": [each.mean().sqrt().item() for each in week],
        "breaks": pump.breaks,
        "seconds": time.perf_counter() - begin,
    }


def tables(runs: Sequence[Run], experiment: Drift) -> dict[str, Table]:
    """All tables, by name."""
    rows = []
    of = {name: [r for r in runs if r["model"] == name] for name in experiment.axes["model"]}
    for name, own in of.items():
        if own:
            seconds = [r["seconds"] for r in own]
            rows.append(
                [
                    *(experiment.axes["model"][name], f"{len(own)}"),
                    number(float(np.mean([r["rmse"] for r in own]))),
                    number(float(np.mean([r["coverage"] for r in own])), ".3f"),
                    number(float(np.mean(seconds)), ".0f"),
                ]
            )
    header = ["model", "pumps", "RMSE of the head a step ahead [m]", "coverage of observations"]
    return {"errors": Table("Errors", markdown([*header, "seconds"], rows))}


def draw(runs: Sequence[Run], experiment: Drift) -> list[Path]:
    """Draw the error of each week of the first pump."""
    seeds = [r["seed"] for r in runs]
    own = {r["model"]: r for r in runs if r["seed"] == min(seeds)}
    figure, (ax,) = panels(["a pump that wears"], 1, (7.5, 3.6))
    for name, color in _COLORS.items():
        if name in own:
            weeks = own[name]["rmse_of_weeks"]
            ax.semilogy(
                np.arange(len(weeks)) + 2, weeks, color=color, label=experiment.axes["model"][name]
            )
    if "rra" in own:
        ax.axvline(own["rra"]["breaks"] / 84, color="tab:red", lw=1, ls="--")
    ax.set(xlabel="week", ylabel="RMSE a step ahead [m]")
    ax.legend(fontsize=8)
    return [save(figure, experiment.out / "drift.png")]
