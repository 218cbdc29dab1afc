"""What the READMEs show of this experiment."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from paper.arm.results import LAST_TRIAL, MEASURES, RMSES, SHOWN, THRESHOLDS, WINDOWS
from paper.arm.runs import ARM
from paper.arm.scenarios import SCENARIOS
from paper.control.report import (
    claims_table,
    describe_settings,
    describe_updates,
    interval,
    model_table,
    numbers,
    paired,
)
from paper.markdown import NOT_RUN, markdown

NAMES = (
    "curves",
    "iqm",
    "map",
    "seconds",
    "all",
    "last",
    "memory",
    "claims",
    "targets",
    "time",
    "model",
    "short",
)
SHORT = ("mf-best", "phy", "gp", "cka", "rra", "cka-memory")  # the learners of the main README


def fragments(folder: Path) -> dict[str, str]:
    """The settings of the arm as they stand, and its results if there are any."""
    found = {"arm:settings": describe_settings(ARM), "arm:updates": describe_updates(ARM)}
    if not (folder / "table.csv").exists():
        return found | {f"arm:{name}": NOT_RUN for name in NAMES}
    table, times, claims = (pd.read_csv(folder / f"{n}.csv") for n in ("table", "time", "claims"))
    for name, figure, caption in (
        ("curves", "curves", "Error over the trials; the number of runs is in brackets"),
        ("iqm", "iqm", "Interquartile means of the error; the number of runs is in brackets"),
        ("map", "map", "Error at each target after trial 9; the number of runs is in brackets"),
        ("seconds", "time", "Seconds of a run"),
    ):
        found[f"arm:{name}"] = f"![{caption}](results/arm/{figure}.png)"
    for name, steps in zip(("all", "last"), MEASURES.values(), strict=True):
        found[f"arm:{name}"] = _errors(table[table["steps"] == steps])
    found["arm:short"] = _short(table[table["steps"] == MEASURES["all_steps"]])
    ours = claims["id"].str.startswith("T")
    parts = {steps: steps for steps in MEASURES.values()}
    found["arm:claims"] = claims_table(claims[~ours], "claim", "steps", parts)
    found["arm:targets"] = claims_table(
        claims[ours], "target", "steps", {MEASURES["all_steps"]: ""}
    )
    times = times.set_index(times["scenario"].map(lambda name: SCENARIOS[name].label))
    memory = folder / "memory.csv"
    found["arm:memory"] = _memory(pd.read_csv(memory)) if memory.stat().st_size > 2 else NOT_RUN
    parts = {
        "fit_seconds": "fits, s",
        "rollout_seconds": "model steps, s",
        "sac_seconds": "updates, s",
        "evaluation_seconds": "evaluations, s",
        "total_seconds": "sum, s",
        "cpu_seconds": "core's time, s",
        "updates": "updates",
    }
    found["arm:time"] = numbers(times[list(parts)], ["of a run", *parts.values()], "{:.0f}")
    errors = ("theta_s, rad", "theta_e, rad", "theta_s', rad/s", "theta_e', rad/s")
    found["arm:model"] = model_table(times, RMSES, errors)
    return found


def _errors(table: pd.DataFrame) -> str:
    header = ["", "runs", *(f"at {trial}" for trial in SHOWN), "sd of runs"]
    header += ["IQM at 30 (95 %)", "100 targets, at 30", "3-9, less Dyna-CKA's"]
    header += ["24-30, less Dyna-CKA's", *(f"first at {t}" for t in THRESHOLDS)]
    rows = []
    for row in table.to_dict("records"):
        values = [*(row[f"at_{trial}"] for trial in SHOWN), row["sd"]]
        firsts = [row[f"first_{t}"] for t in THRESHOLDS]
        rows.append(
            [
                SCENARIOS[row["scenario"]].label,
                f"{row['runs']}",
                *("" if pd.isna(value) else f"{value:.1f}" for value in values),
                "" if pd.isna(row["iqm"]) else interval(row, 1),
                "" if pd.isna(row["hundred"]) else f"{row['hundred']:.1f}",
                *(paired(row, f"more_{trials}", 1) for trials in ("3_9", "24_30")),
                *("never" if pd.isna(first) else f"{first:.0f}" for first in firsts),
            ]
        )
    return markdown(header, rows)


def _short(table: pd.DataFrame) -> str:
    trials, (_, level) = (3, 6, 12, LAST_TRIAL), THRESHOLDS
    header = ["hand's error, cm", *(f"at {trial}" for trial in trials), f"first at {level} cm"]
    rows = []
    for row in table[table["scenario"].isin(SHORT)].to_dict("records"):
        first = row[f"first_{level}"]
        rows.append(
            [
                f"{SCENARIOS[row['scenario']].label} ({row['runs']})",
                *("" if pd.isna(row[f"at_{t}"]) else f"{row[f'at_{t}']:.1f}" for t in trials),
                "never" if pd.isna(first) else f"trial {first:.0f}",
            ]
        )
    return markdown(header, rows)


def _memory(table: pd.DataFrame) -> str:
    header = ["", "runs"]
    for first, last in WINDOWS:
        header += [f"{first}-{last} without", "with", "difference"]
    rows = []
    for row in table.to_dict("records"):
        cells = [SCENARIOS[row["scenario"]].label, f"{row['runs']}"]
        for first, last in WINDOWS:
            trials = f"{first}_{last}"
            cells += [f"{row[f'{form}_{trials}']:.1f}" for form in ("without", "with")]
            cells.append(paired(row, f"more_{trials}", 1))
        rows.append(cells)
    return markdown(header, rows)
