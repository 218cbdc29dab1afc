"""Swinging up a cart-pole: thirteen learners, fifty trials, ten seeds (the paper's sec. 3.2)."""

from __future__ import annotations

import argparse
from pathlib import Path

from paper.cartpole.runs import make_tasks, run_all
from paper.cartpole.scenarios import SCENARIOS
from paper.options import add_options, check_options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment to its command line."""
    add_options(parser, "cartpole", num_runs=10)
    parser.add_argument(
        "--scenarios",
        type=lambda text: tuple(text.split(",")),
        default=tuple(SCENARIOS),
        metavar="NAME,...",
        help=f"learners [{','.join(SCENARIOS)}]",
    )
    parser.add_argument(
        "--backend",
        choices=("loky", "ray"),
        default="loky",
        help="processes on this machine, or on a Ray cluster [loky]",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Run the experiment."""
    unknown = [name for name in arguments.scenarios if name not in SCENARIOS]
    if unknown:
        raise SystemExit(
            f"--scenarios: there is no scenario {unknown[0]!r}, but there are "
            f"{', '.join(SCENARIOS)}"
        )
    check_options(arguments)
    out: Path = arguments.out
    tasks = make_tasks(arguments.scenarios, arguments.runs, arguments.seed)
    run_all(tasks, out, num_jobs=arguments.jobs, backend=arguments.backend)
