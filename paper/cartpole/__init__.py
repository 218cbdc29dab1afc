"""Swinging up a cart-pole: fourteen learners, fifty trials, ten seeds (the paper's sec. 3.2)."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

import pandas as pd

from paper.cartpole.claims import Judge
from paper.cartpole.figure import FLOOR, FLOOR_LABEL, draw_curves
from paper.cartpole.results import MEASURES, RMSES, WINDOWS, load, tabulate
from paper.cartpole.runs import CART_POLE
from paper.cartpole.scenarios import SCENARIOS, SETTINGS
from paper.cartpole.targets import Targets
from paper.control import options
from paper.control.figure import draw_iqm, draw_time
from paper.control.results import tabulate_time

FIGURES = ("curves", "iqm", "time")
LABELS = {name: scenario.label for name, scenario in SCENARIOS.items()}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment to its command line."""
    options.add_arguments(parser, CART_POLE, summarise)


def summarise(out: Path) -> None:
    """Write and print tables, verdicts and figures of all the runs in a folder."""
    trials = load(out)
    table, times, claims = tabulate(trials), tabulate_time(trials, RMSES), verdicts(trials)
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
    draw_iqm(
        trials,
        LABELS,
        {measure: f"{label} actions" for measure, label in MEASURES.items()},
        {(first, last): f"trials {first}-{last}" for first, last in WINDOWS[1:]},
        (FLOOR, FLOOR_LABEL),
        "cost",
        out / "iqm.png",
    )
    draw_time(times, LABELS, out / "time.png")
    print(f"\nFigures: {', '.join(str(out / f'{name}.png') for name in FIGURES)}")


def verdicts(trials: pd.DataFrame) -> pd.DataFrame:
    """Judge the paper's claims and our targets, by sampled and by deterministic actions."""
    rows = [
        {"actions": label, **asdict(claim)}
        for measure, label in MEASURES.items()
        for claim in [*Judge(trials, measure).judge(), *Targets(trials, measure).judge()]
    ]
    return pd.DataFrame(rows)
