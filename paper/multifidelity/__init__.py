"""Functions of low and high fidelity: eight methods, few observations, several data sets."""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from paper.multifidelity.figure import draw
from paper.multifidelity.models import METHODS
from paper.multifidelity.problem import names
from paper.multifidelity.runs import run_all
from paper.options import add_names, add_options, check_names, check_options

PAIRS = ("currin", "branin", "bohachevsky", "booth", "park91a", "hartmann6")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment to its command line."""
    add_options(parser, "multifidelity", num_runs=10)
    add_names(parser, "--pairs", PAIRS, "pairs of mf2")
    add_names(parser, "--methods", METHODS, "methods")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Run the experiment; write and print its tables and figures."""
    check_names("--pairs", "pair", arguments.pairs, names())
    check_names("--methods", "method", arguments.methods, METHODS)
    check_options(arguments)
    out: Path = arguments.out
    runs = run_all(
        arguments.pairs, arguments.methods, arguments.runs, arguments.seed, arguments.jobs, out
    )
    table = tabulate(runs)
    table.to_csv(out / "table.csv", float_format="%.4g")
    for (name, _, N), part in table.groupby(["pair", "per_input", "N"], sort=False):
        print(f"\n{name}, {N} observations:")
        print(part.droplevel([0, 1, 2]).to_string(float_format="%.3g", na_rep=""))
    for column in ("nrmse", "nlpd", "coverage"):
        path = out / f"{column}.png"
        draw(runs, column, path)
        print(f"\nFigure: {path}")


def tabulate(runs: pd.DataFrame) -> pd.DataFrame:
    """Summarise the runs: a row for each pair, number of observations and method."""
    groups = runs.groupby(["pair", "per_input", "N", "method"], sort=False)
    return groups.agg(
        nrmse_median=("nrmse", "median"),
        nrmse_mean=("nrmse", "mean"),
        nlpd_median=("nlpd", "median"),
        nlpd_mean=("nlpd", "mean"),
        crps_median=("crps", "median"),
        crps_mean=("crps", "mean"),
        coverage=("coverage", "mean"),
        seconds=("seconds", "median"),
        chosen=("chosen", _counted),
    )


def _counted(chosen: pd.Series[str]) -> str:
    """How often each structure was chosen, the most frequent first."""
    return ", ".join(f"{name} {count}" for name, count in chosen.dropna().value_counts().items())
