"""Swinging up a cart-pole: thirteen learners, fifty trials, ten seeds (the paper's sec. 3.2)."""

from __future__ import annotations

import argparse
from pathlib import Path

from paper.cartpole.claims import CLAIMS
from paper.cartpole.figure import FLOOR, FLOOR_LABEL, draw_curves
from paper.cartpole.results import MEASURES, RMSES, WINDOWS, load, tabulate
from paper.cartpole.runs import CART_POLE
from paper.cartpole.scenarios import SETTINGS
from paper.cartpole.targets import TARGETS
from paper.control import options
from paper.control.claims import judge
from paper.control.curves import Curves
from paper.control.figure import draw_iqm, draw_time
from paper.control.results import tabulate_time
from paper.control.summary import Summary, verdicts

FIGURES = ("curves", "iqm", "time")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment to its command line."""
    options.add_arguments(parser, CART_POLE, summarise)


def summarise(out: Path) -> None:
    """Write and print tables, verdicts and figures of all the runs in a folder."""
    trials = load(out)
    judged = {
        label: judge([*CLAIMS, *TARGETS], Curves(trials, measure), SETTINGS.num_trials)
        for measure, label in MEASURES.items()
    }
    times = tabulate_time(trials, RMSES)
    summary = Summary("actions", tabulate(trials), times, verdicts("actions", judged))
    summary.write(out)
    summary.show("Mean cost, actions", digits=3)
    draw_curves(trials, SETTINGS.model_until, out / "curves.png")
    draw_iqm(
        trials,
        CART_POLE.labels,
        {measure: f"{label} actions" for measure, label in MEASURES.items()},
        {(first, last): f"trials {first}-{last}" for first, last in WINDOWS[1:]},
        (FLOOR, FLOOR_LABEL),
        "cost",
        out / "iqm.png",
    )
    draw_time(times, CART_POLE.labels, out / "time.png")
    print(f"\nFigures: {', '.join(str(out / f'{name}.png') for name in FIGURES)}")
