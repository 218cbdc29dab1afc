"""Forrester's function: eight models, eight observations, a hundred runs (the paper's sec. 3.1)."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import get_args

import pandas as pd

from paper.forrester.claims import judge
from paper.forrester.figure import draw
from paper.forrester.models import Protocol
from paper.forrester.runs import run_all
from paper.options import add_options, check_options

FIGURE_SEED = 3  # the data set of the six fits


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment to its command line."""
    add_options(parser, "forrester", num_runs=100)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Run the experiment; write and print its table, verdicts and figures."""
    check_options(arguments)
    out: Path = arguments.out
    runs = run_all(arguments.runs, arguments.seed, arguments.jobs, out)
    table, claims = tabulate(runs), verdicts(runs)
    table.to_csv(out / "table.csv", float_format="%.4g")
    claims.to_csv(out / "claims.csv", index=False)
    for (reading, protocol), part in table.groupby(["reading", "protocol"], sort=False):
        print(f"\nReading {reading} of the crude function, protocol '{protocol}':")
        print(part.droplevel(["reading", "protocol"]).to_string(float_format="%.4g", na_rep="-"))
        chosen = (claims["reading"] == reading) & (claims["protocol"] == protocol)
        for claim in claims[chosen].itertuples():
            print(f"  {claim.id} {claim.verdict}: {claim.claim} ({claim.measured})")
    for protocol in get_args(Protocol):
        path = out / f"forrester_{protocol}.png"
        draw(runs, protocol, "B", FIGURE_SEED, path)
        print(f"\nFigure: {path}")


def tabulate(runs: pd.DataFrame) -> pd.DataFrame:
    """Summarise the runs: a row for each reading, protocol and model."""
    groups = runs.groupby(["reading", "protocol", "model"], sort=False)
    return groups.agg(
        rmse_mean=("rmse", "mean"),
        rmse_sd=("rmse", "std"),
        rmse_median=("rmse", "median"),
        nlpd=("nlpd", "mean"),
        crps=("crps", "mean"),
        coverage=("coverage", "mean"),
        seconds=("seconds", "median"),
    )


def verdicts(runs: pd.DataFrame) -> pd.DataFrame:
    """Judge the paper's claims on each reading and protocol."""
    rows = [
        {"reading": reading, "protocol": protocol, **asdict(claim)}
        for (reading, protocol), part in runs.groupby(["reading", "protocol"], sort=False)
        for claim in judge(part)
    ]
    return pd.DataFrame(rows)
