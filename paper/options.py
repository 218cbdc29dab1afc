"""The options that experiments share."""

from __future__ import annotations

import argparse
import os
from pathlib import Path


def add_options(parser: argparse.ArgumentParser, experiment: str, num_runs: int) -> None:
    """Add the options of a grid of runs to an experiment's command line."""
    parser.add_argument(
        "--runs",
        type=int,
        default=num_runs,
        help=f"number of runs, each with a seed of its own [{num_runs}]",
    )
    parser.add_argument("--seed", type=int, default=0, help="the first seed [0]")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count(), help="parallel processes [all cores]"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("results", experiment),
        help=f"folder of the results [results/{experiment}]",
    )


def check_options(arguments: argparse.Namespace) -> None:
    """End the program if an option is out of range, else make the folder of the results."""
    if arguments.runs < 2:
        raise SystemExit(f"--runs: expected at least 2 (for a spread), got {arguments.runs}")
    if arguments.jobs < 1:
        raise SystemExit(f"--jobs: expected at least 1 process, got {arguments.jobs}")
    arguments.out.mkdir(parents=True, exist_ok=True)
