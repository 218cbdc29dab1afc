"""Reaching with a muscle arm: learners with and without physics, thirty trials, ten seeds."""

from __future__ import annotations

import argparse
from pathlib import Path

from paper.arm.claims import claims
from paper.arm.figure import BOUND, BOUND_LABEL, draw_curves, draw_map
from paper.arm.results import (
    LAST_TRIAL,
    MEASURES,
    load,
    load_evaluations,
    load_maps,
    tabulate,
    tabulate_memory,
    tabulate_seconds,
)
from paper.arm.runs import ARM
from paper.arm.targets import targets
from paper.control import options
from paper.control.claims import judge
from paper.control.curves import Curves
from paper.control.figure import draw_iqm, draw_time
from paper.control.summary import Summary, verdicts

FIGURES = ("curves", "iqm", "map", "time")
ENDS = {(t, t): f"after trial {t}" for t in (6, 15, LAST_TRIAL)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this experiment to its command line."""
    options.add_arguments(parser, ARM, summarise)


def summarise(out: Path) -> None:
    """Write and print tables, verdicts and figures of all the runs in a folder."""
    trials, evaluations, maps = load(out), load_evaluations(out), load_maps(out)
    judged = {
        label: judge(claims(maps), Curves(evaluations, measure), LAST_TRIAL)
        for measure, label in MEASURES.items()
    }
    every = Curves(evaluations, "all_steps")
    judged[MEASURES["all_steps"]] += judge(targets(trials, evaluations), every, LAST_TRIAL)
    times = tabulate_seconds(trials, evaluations)
    summary = Summary("steps", tabulate(evaluations), times, verdicts("steps", judged))
    summary.write(out)
    summary.show("Hand's RMSE in cm", digits=1)
    memory = tabulate_memory(evaluations)
    if len(memory):
        print("\nWith and without the previous action, all steps, cm:")
        print(memory.to_string(index=False, float_format="%.1f", na_rep="-"))
    memory.to_csv(out / "memory.csv", index=False, float_format="%.4g")
    draw_curves(evaluations, out / "curves.png")
    line = (BOUND, BOUND_LABEL)
    draw_iqm(evaluations, ARM.labels, MEASURES, ENDS, line, "hand's RMSE, cm", out / "iqm.png")
    draw_map(maps, out / "map.png")
    draw_time(times, ARM.labels, out / "time.png")
    print(f"\nFigures: {', '.join(str(out / f'{name}.png') for name in FIGURES)}")
