"""The options that experiments share."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
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


def add_names(
    parser: argparse.ArgumentParser, option: str, default: Sequence[str], what: str
) -> None:
    """Add an option that takes names, separated by commas; see :func:`check_names`."""
    parser.add_argument(
        option,
        type=lambda text: tuple(text.split(",")),
        default=tuple(default),
        metavar="NAME,...",
        help=f"{what} [{','.join(default)}]",
    )


def add_only_tables(parser: argparse.ArgumentParser) -> None:
    """Add the option of not running anything."""
    parser.add_argument(
        "--only-tables",
        action="store_true",
        help="run nothing; make tables and figures of the runs that are there",
    )


def check_names(option: str, kind: str, given: Sequence[str], known: Sequence[str]) -> None:
    """End the program if a name is unknown or given twice."""
    unknown = [name for name in given if name not in known]
    if unknown:
        raise SystemExit(
            f"{option}: there is no {kind} {unknown[0]!r}, but there are {', '.join(known)}"
        )
    if len(set(given)) < len(given):
        raise SystemExit(f"{option}: expected each {kind} once, got {','.join(given)}")
