"""Reaching with a muscle arm: learners with and without physics, thirty trials, ten seeds."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

import pandas as pd

from paper.arm.claims import Judge
from paper.arm.figure import BOUND, BOUND_LABEL, draw_curves, draw_map
from paper.arm.results import (
    LAST,
    MEASURES,
    load,
    load_evaluations,
    load_maps,
    tabulate,
    tabulate_seconds,
)
from paper.arm.runs import ARM
from paper.arm.scenarios import SCENARIOS
from paper.arm.targets import Targets
from paper.control import options
from paper.control.figure import draw_iqm, draw_time

FIGURES = ("curves", "iqm", "map", "time")
LABELS = {name: scenario.label for name, scenario in SCENARIOS.items()}
ENDS = {(6, 6): "after trial 6", (15, 15): "after trial 15", (LAST, LAST): f"after trial {LAST}"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment to its command line."""
    options.add_arguments(parser, ARM, summarise)


def summarise(out: Path) -> None:
    """Write and print tables, verdicts and figures of all the runs in a folder."""
    trials, evaluations, maps = load(out), load_evaluations(out), load_maps(out)
    table, times = tabulate(evaluations), tabulate_seconds(trials, evaluations)
    claims = verdicts(trials, evaluations, maps)
    table.to_csv(out / "table.csv", index=False, float_format="%.4g")
    times.to_csv(out / "time.csv", index=False, float_format="%.4g")
    claims.to_csv(out / "claims.csv", index=False)
    for steps, part in table.groupby("steps", sort=False):
        print(f"\nHand's RMSE in cm, {steps}:")
        print(part.drop(columns="steps").to_string(index=False, float_format="%.1f", na_rep="-"))
        for claim in claims[claims["steps"] == steps].itertuples():
            print(f"  {claim.id} {claim.verdict}: {claim.claim} ({claim.measured})")
    print("\nMean of a run:")
    print(times.to_string(index=False, float_format="%.4g", na_rep="-"))
    draw_curves(evaluations, out / "curves.png")
    line = (BOUND, BOUND_LABEL)
    draw_iqm(evaluations, LABELS, MEASURES, ENDS, line, "hand's RMSE, cm", out / "iqm.png")
    draw_map(maps, out / "map.png")
    draw_time(times, LABELS, out / "time.png")
    print(f"\nFigures: {', '.join(str(out / f'{name}.png') for name in FIGURES)}")


def verdicts(trials: pd.DataFrame, evaluations: pd.DataFrame, maps: pd.DataFrame) -> pd.DataFrame:
    """Judge the paper's claims, over all steps and over the last, and our targets over all."""
    rows = [
        {"steps": label, **asdict(claim)}
        for measure, label in MEASURES.items()
        for claim in Judge(evaluations, maps, measure).judge()
    ]
    label = MEASURES["all_steps"]
    rows += [{"steps": label, **asdict(c)} for c in Targets(trials, evaluations).judge()]
    return pd.DataFrame(rows)
