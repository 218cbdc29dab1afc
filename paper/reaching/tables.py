"""Tables and verdicts of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from paper.common.claims import Claim, Finding, judge, met
from paper.common.curves import Curves, load_trials
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown, number
from paper.reaching import LEARNERS, SYSTEMS, Reaching

_SHOWN = (1, 2, 3, 4, 6, 10)  # trials


def load_maps(records: Sequence[Record]) -> pd.DataFrame:
    """The errors over all steps in cm: a row for each run, mapped trial and target."""
    frames = [
        pd.DataFrame(
            {
                "system": record["system"],
                "scenario": record["learner"],
                "seed": record["seed"],
                "episode": int(trial),
                "target": range(len(errors)),
                "all_steps": errors,
            }
        )
        for record in records
        for trial, errors in record["maps"].items()
    ]
    return pd.concat(frames, ignore_index=True)


def tables(records: Sequence[Record], experiment: Reaching) -> dict[str, Table]:
    """All tables, by name."""
    trials, last = load_trials(records), experiment.settings.trials
    found = {}
    for system, label in SYSTEMS.items():
        own = trials[trials["system"] == system]
        for measure, steps in (("all_steps", "all steps"), ("last_five", "last five steps")):
            if len(own):
                title = f"The hand's error in cm, {steps}, arm {label}"
                found[f"{system}_{measure}"] = Table(title, _errors(own, measure, last))
    plain = Curves(trials[trials["system"] == "plain"], "all_steps")
    judged = {"all steps": judge(TARGETS, plain, last)}
    found["targets"] = Table("Targets", claims_table("target", judged))
    found["seconds"] = Table("Seconds of a trial", _seconds(trials))
    return found


def _errors(own: pd.DataFrame, measure: str, last: int) -> str:
    curves = Curves(own, measure)
    names = [name for name in LEARNERS if name in curves.names]
    shown = [trial for trial in _SHOWN if trial <= own["episode"].max()]
    header = ["", "runs", *(f"trial {i}" for i in shown), f"worst of 3-{last}", "less CKA's"]
    rows = []
    for name in names:
        late = own[(own["scenario"] == name) & own["episode"].between(3, last)][measure]
        gap = curves.paired_difference(name, 1, last).text(".1f") if "cka" in names else ""
        cells = [number(curves.mean_at(name, i), ".1f") for i in shown]
        row = [LEARNERS[name], f"{len(curves.seeds(name))}", *cells]
        rows.append([*row, number(late.max(), ".1f"), gap])
    return markdown(header, rows)


def _seconds(trials: pd.DataFrame) -> str:
    columns = ["update_seconds", "fit_seconds", "cpu_seconds"]
    medians = trials[trials["episode"] > 1].groupby("scenario")[columns].median()
    rows = [
        [LEARNERS[name], *(number(value, ".1f") for value in medians.loc[name])]
        for name in LEARNERS
        if name in medians.index
    ]
    return markdown(["median of a trial", "policy search, s", "fit, s", "CPU, s"], rows)


def _after(most: float, trial: int, curves: Curves) -> Finding:
    errors = curves.window("cka", trial, trial)
    measured = f"{errors.mean():.1f} cm of {len(errors)} runs, the worst {errors.max():.1f}"
    return met(errors.mean() <= most), measured


def _never_above(curves: Curves) -> Finding:
    own = curves.records[curves.records["scenario"] == "cka"]
    late = own[own["episode"] >= 3]["all_steps"]
    return met(late.max() <= 8), f"{late.max():.1f} cm"


TARGETS = (
    Claim("T1", "mean at most 8 cm after trial 1", ("cka",), lambda c: _after(8, 1, c)),
    Claim("T2", "mean at most 6.5 cm after trial 2", ("cka",), lambda c: _after(6.5, 2, c)),
    Claim("T3", "mean at most 5.5 cm after trial 4", ("cka",), lambda c: _after(5.5, 4, c)),
    Claim("T4", "mean at most 4.5 cm after trial 10", ("cka",), lambda c: _after(4.5, 10, c)),
    Claim("T5", "no run above 8 cm after trial 3 or a later one", ("cka",), _never_above),
)
