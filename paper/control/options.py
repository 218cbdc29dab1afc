"""The command line of a control experiment."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from paper.control.experiment import Experiment
from paper.control.runs import make_tasks, run_all
from paper.options import (
    add_names,
    add_only_tables,
    add_options,
    check_names,
    check_options,
)


def add_arguments(
    parser: argparse.ArgumentParser, experiment: Experiment, summarise: Callable[[Path], None]
) -> None:
    """Add the options of an experiment to its command line.

    Args:
        parser: The experiment's.
        experiment: What is run.
        summarise: Writes and prints the summary of all the runs in a folder.
    """
    add_options(parser, experiment.name, num_runs=10)
    add_names(parser, "--scenarios", tuple(experiment.scenarios), "learners")
    parser.add_argument(
        "--backend",
        choices=("loky", "ray"),
        default="loky",
        help="processes on this machine, or on a Ray cluster [loky]",
    )
    add_only_tables(parser)
    parser.set_defaults(run=partial(_run, experiment, summarise))


def _run(
    experiment: Experiment, summarise: Callable[[Path], None], arguments: argparse.Namespace
) -> None:
    """Run the experiment; write and print its tables, verdicts and figures."""
    check_names("--scenarios", "scenario", arguments.scenarios, tuple(experiment.scenarios))
    check_options(arguments)
    tasks = make_tasks(experiment, arguments.scenarios, arguments.runs, arguments.seed)
    if not arguments.only_tables:
        try:
            experiment.check()
        except ImportError as error:
            raise SystemExit(str(error)) from error
        run_all(
            experiment, tasks, arguments.out, num_jobs=arguments.jobs, backend=arguments.backend
        )
    summarise(arguments.out)
