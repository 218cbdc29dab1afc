"""What the tables of control experiments share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from paper.common.curves import Curves
from paper.common.experiment import Record
from paper.common.statistics import interquartile_mean
from paper.common.tables import markdown, number, numbers
from paper.control import Control

PARTS = ("fit", "rollout", "update")


def load_episodes(records: Sequence[Record], experiment: Control) -> pd.DataFrame:
    """A row for each scenario, seed and episode (from 1), a column for each state's error."""
    names = [f"rmse_{state}" for state in experiment.rmses]
    frames = []
    for record in records:
        if record["scenario"] in experiment.known:
            frame = pd.DataFrame(record["episodes"])
            frame.insert(0, "episode", np.arange(len(frame)) + 1)
            errors = [found or [np.nan] * len(names) for found in frame.pop("rmse")]
            frame[names] = np.array(errors, dtype=float)
            frames.append(of_run(frame.astype({"nlpd": float, "coverage": float}), record))
    return in_order(frames, experiment)


def of_run(frame: pd.DataFrame, record: Record) -> pd.DataFrame:
    """Say in a table of whose run it is; the table itself is changed."""
    frame.insert(0, "scenario", record["scenario"])
    frame.insert(1, "seed", record["seed"])
    return frame


def in_order(frames: Sequence[pd.DataFrame], experiment: Control) -> pd.DataFrame:
    """Tables as one, sorted by scenario (as listed), seed and episode."""
    rank = list(experiment.known).index
    return (
        pd.concat(frames)
        .sort_values(
            ["scenario", "seed", "episode"],
            key=lambda c: c.map(rank) if c.name == "scenario" else c,
            kind="stable",
        )
        .reset_index(drop=True)
    )


def updates_table(experiment: Control) -> str:
    """How many gradient steps each scenario makes after an episode."""
    shared = experiment.settings
    until = shared.last_model_episode
    starts = [1, until + 1] if until < shared.episodes else [1]
    rows = []
    for name, scenario in experiment.known.items():
        settings, cells = experiment.settings_of(name), []
        for episode in starts:
            real = settings.updates_after(episode, scenario.model is None)
            in_model = scenario.model is not None and episode <= until
            cells.append(f"{real} + {settings.updates_in_model()}" if in_model else f"{real}")
        rows.append([f"`{name}`", scenario.label, *cells, f"{scenario.max_runs or 'all'}"])
    headings = [f"updates, trials 1-{until}", f"{until + 1}-"][: len(starts)]
    return markdown(["`--scenarios`", "", *headings, "seeds"], rows)


def summary(
    experiment: Control,
    curves: Curves,
    columns: Mapping[str, Callable[[str], Any]],
    *,
    end: tuple[int, int],
    windows: Sequence[tuple[int, int]],
    thresholds: Sequence[float],
    digits: int,
    texts: Mapping[str, Callable[[str], str]] | None = None,
) -> str:
    """A row for each learner.

    Args:
        experiment: Whose learners they are.
        curves: Of the measure.
        columns: By their heading, what gives a number of a learner.
        end: The episodes that the interquartile mean is of.
        windows: Episodes over which the learners are compared with the reference.
        thresholds: Whose first episodes are shown.
        digits: After the point.
        texts: Further columns, as they are shown.
    """
    texts = texts or {}
    form, other = f".{digits}f", experiment.labels[curves.reference]
    rows = []
    for name in curves.names:
        row = [experiment.labels[name], f"{len(curves.seeds(name))}"]
        row += [number(value(name), form) for value in columns.values()]
        middle, low, high = interquartile_mean(curves.window(name, *end))
        row.append(number(middle, form))
        if not np.isnan(low):
            row[-1] += f" ({low:{form}}, {high:{form}})"
        row += [curves.paired_difference(name, *window).text(form) for window in windows]
        firsts = [curves.first_below(name, threshold) for threshold in thresholds]
        row += ["never" if first is None else f"{first}" for first in firsts]
        rows.append([*row, *(text(name) for text in texts.values())])
    said = f"{end[0]}-{end[1]}" if end[0] < end[1] else f"{end[0]}"
    header = ["", "runs", *columns, f"IQM of {said} (95 %)"]
    header += [f"{first}-{last}, less {other}'s" for first, last in windows]
    header += [f"first at {threshold:g}" for threshold in thresholds]
    return markdown([*header, *texts], rows)


def short_summary(
    curves: Curves, labels: Mapping[str, str], columns: Mapping[str, Callable[[str], float]],
    heading: str, level: float, unit: str, digits: int,
) -> str:  # fmt: skip
    """A row for each of some learners: a few numbers, and when a level is reached first."""
    rows = []
    for name, label in labels.items():
        if name in curves.names:
            first = curves.first_below(name, level)
            cells = [number(value(name), f".{digits}f") for value in columns.values()]
            rows.append([label, *cells, "never" if first is None else f"trial {first}"])
    return markdown([heading, *columns, f"first at {level:g}{unit}"], rows)


def seconds_of_a_run(rows: pd.DataFrame, parts: Sequence[str]) -> pd.DataFrame:
    """Medians over the runs of the seconds in each part that there is: a row for each scenario.

    Args:
        rows: Those of the runs, with a column ``..._seconds`` for each part.
        parts: Their names.
    """
    columns = [f"{part}_seconds" for part in parts if f"{part}_seconds" in rows]
    by_run = rows.groupby(["scenario", "seed"], sort=False)[columns].sum()
    return by_run.groupby("scenario", sort=False).median()


def cost_of_a_run(episodes: pd.DataFrame) -> pd.DataFrame:
    """Seconds of a run in each part, its updates, and the particles that it lost.

    ``cpu_seconds`` are of the whole run on its core, the others of wall time; they are medians over
    the runs, as a run may have been suspended.
    """
    total = sum(episodes[f"{part}_seconds"] for part in PARTS)
    table = seconds_of_a_run(episodes.assign(total_seconds=total), (*PARTS, "total", "cpu"))
    by_run = episodes.groupby(["scenario", "seed"], sort=False)[["updates", "left_bounds"]].sum()
    table[["updates", "left_bounds"]] = by_run.groupby("scenario", sort=False).mean()
    return table


def foresight(episodes: pd.DataFrame, experiment: Control) -> str:
    """How well the models foresaw episodes, from the second: the first that a learnt one can."""
    errors = [f"rmse_{state}" for state in experiment.rmses]
    scored = episodes[episodes["episode"] > 1].groupby("scenario", sort=False)
    table = scored[["nlpd", *errors]].median()
    table.insert(1, "coverage", scored["coverage"].mean())
    table["lost"] = cost_of_a_run(episodes)["left_bounds"]
    table = table[table[errors[0]].notna()].rename(index=experiment.labels)
    headings = [f"RMSE of {what}" for what in experiment.rmses.values()]
    return numbers(table, ["", "NLPD", "coverage of 95 %", *headings, "particles lost"], ".2g")
