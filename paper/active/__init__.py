"""Where to measure: six ways to choose, four problems, the error over the measurements."""

from __future__ import annotations

import argparse
from pathlib import Path

from paper.active.figure import draw
from paper.active.learners import LEARNERS
from paper.active.problems import NAMES, problem
from paper.active.results import load, tabulate, verdicts
from paper.active.runs import make_tasks, run_all
from paper.options import add_names, add_only_tables, add_options, check_names, check_options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment to its command line."""
    add_options(parser, "active", num_runs=20)
    add_names(parser, "--problems", NAMES, "problems")
    add_names(parser, "--learners", tuple(LEARNERS), "learners")
    add_only_tables(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Run the experiment; write and print its tables, verdicts and figure."""
    check_names("--problems", "problem", arguments.problems, NAMES)
    check_names("--learners", "learner", arguments.learners, tuple(LEARNERS))
    check_options(arguments)
    tasks = make_tasks(arguments.problems, arguments.learners, arguments.runs, arguments.seed)
    if not arguments.only_tables:
        run_all(tasks, arguments.out, arguments.jobs)
    summarise(arguments.out)


def summarise(out: Path) -> None:
    """Write and print tables, verdicts and the figure of all the runs in a folder."""
    runs = load(out)
    table, claims = tabulate(runs), verdicts(runs)
    table.to_csv(out / "table.csv", index=False, float_format="%.4g")
    claims.to_csv(out / "claims.csv", index=False)
    for name, rows in table.groupby("problem", sort=False):
        print(f"\n{name}:")
        rows = rows.drop(columns="problem").replace({"needed": float("inf")}, "never")
        print(rows.to_string(index=False, float_format="%.3g", na_rep="-"))
    for claim in claims.itertuples():
        print(f"  {claim.id} {claim.verdict}: {claim.claim} ({claim.measured})")
    path = out / "errors.png"
    draw(runs, {name: problem(name, 0).title for name in NAMES}, path)
    print(f"\nFigure: {path}")
