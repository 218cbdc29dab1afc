"""Swinging up a cart-pole: fourteen learners, fifty trials, ten seeds (the paper's sec. 3.2)."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

import pandas as pd

from paper.cartpole.claims import Judge
from paper.cartpole.figure import draw_curves, draw_iqm, draw_time
from paper.cartpole.results import MEASURES, WINDOWS, load, tabulate, tabulate_time
from paper.cartpole.runs import make_tasks, run_all
from paper.cartpole.scenarios import SCENARIOS, SETTINGS
from paper.cartpole.targets import Targets
from paper.options import add_options, check_options

FIGURES = ("curves", "iqm", "time")


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
    parser.add_argument(
        "--only-tables",
        action="store_true",
        help="run nothing; make tables and figures of the runs that are there",
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Run the experiment; write and print its tables, verdicts and figures."""
    unknown = [name for name in arguments.scenarios if name not in SCENARIOS]
    if unknown:
        raise SystemExit(
            f"--scenarios: there is no scenario {unknown[0]!r}, but there are "
            f"{', '.join(SCENARIOS)}"
        )
    check_options(arguments)
    out: Path = arguments.out
    tasks = make_tasks(arguments.scenarios, arguments.runs, arguments.seed)
    if not arguments.only_tables:
        run_all(tasks, out, num_jobs=arguments.jobs, backend=arguments.backend)
    summarise(out)


def summarise(out: Path) -> None:
    """Write and print tables, verdicts and figures of all the runs in a folder."""
    trials = load(out)
    table, times, claims = tabulate(trials), tabulate_time(trials), verdicts(trials)
    table.to_csv(out / "table.csv", index=False, float_format="%.4g")
    times.to_csv(out / "time.csv", index=False, float_format="%.4g")
    claims.to_csv(out / "claims.csv", index=False)
    for actions, part in table.groupby("actions", sort=False):
        print(f"\nMean cost, {actions} actions:")
        print(part.drop(columns="actions").to_string(index=False, float_format="%.3f", na_rep="-"))
        for claim in claims[claims["actions"] == actions].itertuples():
            print(f"  {claim.id} {claim.verdict}: {claim.claim} ({claim.measured})")
    print("\nMean of a run:")
    print(times.to_string(index=False, float_format="%.4g", na_rep="-"))
    draw_curves(trials, SETTINGS.model_until, out / "curves.png")
    draw_iqm(trials, WINDOWS[1:], out / "iqm.png")
    draw_time(trials, out / "time.png")
    print(f"\nFigures: {', '.join(str(out / f'{name}.png') for name in FIGURES)}")


def verdicts(trials: pd.DataFrame) -> pd.DataFrame:
    """Judge the paper's claims and our targets, by sampled and by deterministic actions."""
    rows = [
        {"actions": label, **asdict(claim)}
        for measure, label in MEASURES.items()
        for claim in [*Judge(trials, measure).judge(), *Targets(trials, measure).judge()]
    ]
    return pd.DataFrame(rows)
