"""The paper's figure 1: six fits, and the errors of all models."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gpadjust import RRA
from paper.forrester.models import MODELS, Protocol, trained
from paper.forrester.problem import CRUDE, LOWER, UPPER, Reading, observations, truth

PANELS = ("Zero-mean GP", "Phy-mean GP", "GP-scale", "AR1", "CKA", "RRA")


def draw(runs: pd.DataFrame, protocol: Protocol, reading: Reading, seed: int, path: Path) -> None:
    """Draw the figure for one protocol and reading and save it.

    Args:
        runs: The scores of all runs.
        protocol: Which protocol to show.
        reading: Which reading of the crude function.
        seed: The data set of the six fits.
        path: Where to save the PNG.
    """
    figure = Figure(figsize=(13, 6), layout="constrained")
    axes: dict[str, Axes] = figure.subplot_mosaic(
        [["a", "b", "c", "g"], ["d", "e", "f", "g"]], width_ratios=[1, 1, 1, 1.2]
    )
    for letter, name in zip("abcdef", PANELS, strict=True):
        _fit_panel(axes[letter], name, protocol, reading, seed)
        axes[letter].set_title(f"({letter}) {name}", loc="left")
    figure.legend(*axes["a"].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    for letter in "ad":
        axes[letter].set_ylabel("y")
    for letter in "def":
        axes[letter].set_xlabel("x")
    chosen = runs[(runs["protocol"] == protocol) & (runs["reading"] == reading)]
    _error_panel(axes["g"], chosen)
    with mpl.rc_context({"savefig.dpi": 110}):
        figure.savefig(path)


def _fit_panel(ax: Axes, name: str, protocol: Protocol, reading: Reading, seed: int) -> None:
    x = torch.linspace(LOWER, UPPER, 200, dtype=torch.float64).unsqueeze(-1)
    X, Y = observations(seed)
    model = trained(name, protocol, reading, X, Y)
    with torch.no_grad():
        posterior = model.posterior(x, observation_noise=True)
        mean, sd = posterior.mean.squeeze(-1), posterior.variance.sqrt().squeeze(-1)
    ax.fill_between(
        x.squeeze(-1), mean - 2 * sd, mean + 2 * sd, color="navy", alpha=0.15, lw=0, label="2 sd"
    )
    if isinstance(model, RRA):
        torch.manual_seed(seed)
        functions = model.sample_functions(20)(x).squeeze(-1)
        ax.plot(x.squeeze(-1), functions.mT, color="navy", lw=0.4, alpha=0.6)
    ax.plot(x, truth(x), color="black", lw=1, label="truth")
    ax.plot(x, CRUDE[reading](x), color="black", ls="--", lw=1, label="f_p")
    ax.plot(x.squeeze(-1), mean, color="navy", lw=1.6, label="mean")
    ax.plot(X, Y, "o", color="red", ms=4, label="data")
    ax.set_ylim(-9, 9)


def _error_panel(ax: Axes, runs: pd.DataFrame) -> None:
    by_model = runs.groupby("model")["rmse"]
    names = ["f_p", *MODELS]
    mean, sd = by_model.mean()[names], by_model.std()[names]
    ax.barh(names, mean, color=["0.6", *["tab:blue"] * len(MODELS)])
    # The lower half of a bar cannot fall below zero.
    ax.errorbar(mean, names, xerr=[sd.clip(upper=mean), sd], fmt="none", color="black", capsize=3)
    for name in names:
        ax.annotate(
            f"{mean[name]:.2g}",
            (mean[name] + sd[name], name),
            xytext=(5, 0),
            textcoords="offset points",
            va="center",
        )
    ax.invert_yaxis()
    ax.margins(x=0.15)
    ax.set_xlabel("mean RMSE and sd")
    ax.set_title(f"(g) {runs['seed'].nunique()} runs", loc="left")
