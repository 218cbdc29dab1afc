"""Which real trials teach the dynamics of a cart-pole most: random, SAC's or informative ones."""

from __future__ import annotations

import argparse
from pathlib import Path

from paper.control import options
from paper.exploration.figure import draw_curves
from paper.exploration.results import MEASURES, load, tabulate, tabulate_seconds
from paper.exploration.runs import EXPLORATION


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment to its command line."""
    options.add_arguments(parser, EXPLORATION, summarise)


def summarise(out: Path) -> None:
    """Write and print the tables and the figure of all the runs in a folder."""
    trials = load(out)
    table, seconds = tabulate(trials), tabulate_seconds(trials)
    for name, made in (("table", table), ("seconds", seconds)):
        made.to_csv(out / f"{name}.csv", index=False, float_format="%.4g")
    for measure, label in MEASURES.items():
        rows = table[table["measure"] == measure].drop(columns="measure")
        print(f"\nMean {label}, after trials:")
        print(rows.to_string(index=False, float_format="%.3f", na_rep="-"))
    print("\nMedian seconds of a run:")
    print(seconds.to_string(index=False, float_format="%.4g", na_rep="-"))
    draw_curves(trials, out / "curves.png")
    print(f"\nFigure: {out / 'curves.png'}")
