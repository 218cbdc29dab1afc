"""The tables of the runs that there are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pandas as pd

from paper.arm import SCENARIOS
from paper.arm.claims import LAST, claims, targets
from paper.common.claims import judge
from paper.common.curves import Curves
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown, numbers
from paper.control import Control
from paper.control.tables import (
    cost_of_a_run,
    foresight,
    in_order,
    load_episodes,
    of_run,
    seconds_of_a_run,
    short_summary,
    summary,
    updates_table,
)

MEASURES = {"all_steps": "all steps", "last_five": "last five steps"}
WINDOWS = ((3, 9), (24, 30))
_SHOWN = (3, 6, 9, 12, 18, 24, 30)  # episodes
_SHORT = ("mf", "mf-best", "phy", "gp", "cka", "rra", "cka-memory")  # the learners of the main README


def load_evaluations(records: Sequence[Record], experiment: Control) -> pd.DataFrame:
    """A row for each scenario, seed and evaluation (episode 0: before the first).

    Columns ``all_steps`` and ``last_five`` are the hand's root mean square distance over all
    targets in cm, those with ``_100`` over the paper's hundred.
    """
    frames = [of_run(pd.DataFrame(record["evaluations"]), record) for record in records]
    return in_order(frames, experiment)


def load_maps(records: Sequence[Record], experiment: Control) -> pd.DataFrame:
    """The errors in cm: a row for each scenario, seed, mapped episode and target."""
    frames = []
    for record in records:
        for episode, errors in record["maps"].items():
            targets = range(len(errors["all_steps"]))
            frame = pd.DataFrame({"episode": int(episode), "target": targets, **errors})
            frames.append(of_run(frame, record))
    columns = ["scenario", "seed", "episode", "target", *MEASURES]
    return in_order(frames, experiment) if frames else pd.DataFrame(columns=columns)


def times(episodes: pd.DataFrame, evaluations: pd.DataFrame) -> pd.DataFrame:
    """The seconds of a run, evaluations included, and its updates."""
    table = cost_of_a_run(episodes)
    seconds = seconds_of_a_run(evaluations, ["evaluation"])["evaluation_seconds"]
    table.insert(3, "evaluation_seconds", seconds)
    table["total_seconds"] += seconds
    return table


def tables(records: Sequence[Record], experiment: Control) -> dict[str, Table]:
    """All tables, by name."""
    episodes, maps = load_episodes(records, experiment), load_maps(records, experiment)
    evaluations = load_evaluations(records, experiment)
    of = {measure: Curves(evaluations, measure) for measure in MEASURES}
    every, seconds = of["all_steps"], times(episodes, evaluations)
    found = {"updates": Table("Updates", updates_table(experiment))}
    about = claims(episodes, maps)
    judged = {MEASURES[m]: judge(about, of[m], LAST) for m in MEASURES}
    found["claims"] = Table("Claims", claims_table("claim", judged))
    judged = {"": judge(targets(seconds), every, LAST)}
    found["targets"] = Table("Targets, all steps", claims_table("target", judged))
    for name, measure in (("all", "all_steps"), ("last", "last_five")):
        hundred = Curves(evaluations, f"{measure}_100")
        columns: dict[str, Callable[[str], Any]] = {
            **{f"at {e}": partial(_at, of[measure], e) for e in _SHOWN},
            "sd of runs": partial(_spread, of[measure]),
            f"100 targets, at {LAST}": partial(_at, hundred, LAST),
        }
        text = summary(
            experiment,
            of[measure],
            columns,
            end=(LAST, LAST),
            windows=WINDOWS,
            thresholds=(10, 8),
            digits=1,
        )
        found[name] = Table(f"Hand's error in cm, {MEASURES[measure]}", text)
    labels = {n: f"{SCENARIOS[n].label} ({len(every.seeds(n))})" for n in _SHORT}
    few = {f"at {episode}": partial(_at, every, episode) for episode in (3, 6, 12, LAST)}
    short = short_summary(every, labels, few, "hand's error, cm", 8, " cm", 1)
    found["short"] = Table("Hand's error in cm, all steps", short)
    found["memory"] = Table("With and without the previous action, cm", _memory(every, experiment))
    found["model"] = Table("How well models foresaw trials", foresight(episodes, experiment))
    parts = {
        "fit_seconds": "fits, s",
        "rollout_seconds": "model steps, s",
        "update_seconds": "updates, s",
        "evaluation_seconds": "evaluations, s",
        "total_seconds": "sum, s",
        "cpu_seconds": "core's time, s",
        "updates": "updates",
    }
    rows = seconds.rename(index=experiment.labels)[list(parts)]
    found["time"] = Table("Seconds", numbers(rows, ["of a run", *parts.values()], ".0f"))
    return found


def _at(curves: Curves, episode: int, name: str) -> float:
    return curves.mean_at(name, episode)


def _spread(curves: Curves, name: str) -> float:
    """The standard deviation over runs, averaged over the evaluations from episode 3."""
    return float(curves.spread(name).loc[3:].mean())


def _memory(every: Curves, experiment: Control) -> str:
    """What the previous action as an input brings, of the seeds that both forms have."""
    header, rows = ["", "runs"], []
    for first, last in WINDOWS:
        header += [f"{first}-{last} without", "with", "difference"]
    for name in experiment.known:
        remembering = f"{name}-memory"
        if not {name, remembering} <= set(every.names):
            continue
        curves = every.restricted(every.seeds(name) & every.seeds(remembering))
        cells = [experiment.labels[name], f"{len(curves.seeds(name))}"]
        for window in WINDOWS:
            cells += [f"{curves.window(n, *window).mean():.1f}" for n in (name, remembering)]
            gap = curves.paired_difference(remembering, *window, reference=name)
            cells.append(gap.text(".1f"))
        rows.append(cells)
    return markdown(header, rows)
