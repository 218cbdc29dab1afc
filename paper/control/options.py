"""The command line of a control experiment."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from paper.control.experiment import Experiment
from paper.control.runs import make_tasks, run_all
from paper.options import add_options, check_options


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
    parser.add_argument(
        "--scenarios",
        type=lambda text: tuple(text.split(",")),
        default=tuple(experiment.scenarios),
        metavar="NAME,...",
        help=f"learners [{','.join(experiment.scenarios)}]",
    )
    parser.add_argument(
        "--backend",
        choices=("loky", "ray"),
        default="loky",
        help="processes on this machine, or on a Ray cluster [loky]",
    )
    parser.add_argument(
        "--only-tables",
        action="store_true",
        help="run nothing; make tables and figures of the runs that are there",
    )
    parser.set_defaults(run=partial(_run, experiment, summarise))


def _run(
    experiment: Experiment, summarise: Callable[[Path], None], arguments: argparse.Namespace
) -> None:
    """Run the experiment; write and print its tables, verdicts and figures."""
    scenarios = experiment.scenarios
    unknown = [name for name in arguments.scenarios if name not in scenarios]
    if unknown:
        raise SystemExit(
            f"--scenarios: there is no scenario {unknown[0]!r}, but there are "
            f"{', '.join(scenarios)}"
        )
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
