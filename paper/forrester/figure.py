"""The paper's figure 1: six fits, and the errors of all models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from gpadjust import RRA
from paper.common.experiment import Record
from paper.common.figures import save
from paper.forrester import Forrester, Settings
from paper.forrester.problem import CRUDE, LOWER, UPPER, Reading, observations, truth
from paper.forrester.run import MODELS, Protocol, trained
from paper.forrester.tables import PROTOCOLS, load

READING: Reading = "B"
SEED = 3  # the data set of the six fits
PANELS = ("Zero-mean GP", "Phy-mean GP", "GP-scale", "AR1", "CKA", "RRA")


def draw(records: Sequence[Record], experiment: Forrester) -> list[Path]:
    """Draw the figure for each protocol, of reading B."""
    runs = load(records)
    return [_draw(runs, protocol, experiment) for protocol in PROTOCOLS]


def _draw(runs: pd.DataFrame, protocol: Protocol, experiment: Forrester) -> Path:
    figure = Figure(figsize=(13, 6), layout="constrained")
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [["a", "b", "c", "g"], ["d", "e", "f", "g"]], width_ratios=[1, 1, 1, 1.2]
    )
    for letter, name in zip("abcdef", PANELS, strict=True):
        _fit_panel(axes[letter], name, protocol, experiment.settings)
        axes[letter].set_title(f"({letter}) {name}", loc="left")
    figure.legend(*axes["a"].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    for letter in "ad":
        axes[letter].set_ylabel("y")
    for letter in "def":
        axes[letter].set_xlabel("x")
    _error_panel(axes["g"], runs[(runs["protocol"] == protocol) & (runs["reading"] == READING)])
    return save(figure, experiment.out / f"forrester_{protocol}.png")


def _fit_panel(ax: Axes, name: str, protocol: Protocol, settings: Settings) -> None:
    x = torch.linspace(LOWER, UPPER, 200, dtype=torch.float64).unsqueeze(-1)
    X, Y = observations(SEED, settings.observations)
    model = trained(name, protocol, READING, X, Y, settings)
    with torch.no_grad():
        posterior = model.posterior(x, observation_noise=True)
        mean, sd = posterior.mean.squeeze(-1), posterior.variance.sqrt().squeeze(-1)
    ax.fill_between(
        x.squeeze(-1), mean - 2 * sd, mean + 2 * sd, color="navy", alpha=0.15, lw=0, label="2 sd"
    )
    if isinstance(model, RRA):
        torch.manual_seed(SEED)
        functions = model.sample_functions(20)(x).squeeze(-1)
        ax.plot(x.squeeze(-1), functions.mT, color="navy", lw=0.4, alpha=0.6)
    ax.plot(x, CRUDE[READING](x), color="black", ls="--", lw=1, label="f_p")
    ax.plot(x.squeeze(-1), mean, color="tab:blue", lw=3.5, label="mean")
    ax.plot(x, truth(x), color="black", lw=1, label="truth")
    ax.plot(X, Y, "o", color="red", ms=4, label="data")
    ax.set_ylim(-9, 9)


def _error_panel(ax: Axes, runs: pd.DataFrame) -> None:
    """The error of each run, on a logarithmic axis, with mean and median."""
    names = ["f_p", *MODELS]
    for row, name in enumerate(names):
        values = runs[runs["model"] == name]["rmse"]
        label = "a run" if name == "CKA" else None
        ax.plot(
            values, [row] * len(values), "o", color="tab:blue", ms=4, mew=0, alpha=0.2, label=label
        )
        for value, mark, what in ((values.mean(), "D", "mean"), (values.median(), "|", "median")):
            label = what if name == "CKA" else None
            ax.plot(
                value, row, mark, color="black", ms=5 if mark == "D" else 13, mew=1.5, label=label
            )
    ax.set_yticks(range(len(names)), names)
    ax.set_xscale("log")
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.invert_yaxis()
    ax.grid(axis="x", color="0.9", lw=0.6)
    ax.set_axisbelow(True)
    ax.legend(loc="upper left", fontsize="small")
    ax.set_xlabel("RMSE")
    ax.set_title(f"(g) {runs['seed'].nunique()} runs", loc="left")
