"""Tables and verdicts of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from paper.common.claims import Claim, Finding, judge, met
from paper.common.curves import Curves, load_trials
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown, number
from paper.planning import LEARNERS, SYSTEMS, Planning


def tables(records: Sequence[Record], experiment: Planning) -> dict[str, Table]:
    """All tables, by name."""
    trials, last = load_trials(records), experiment.settings.trials
    found = {}
    for system, label in SYSTEMS.items():
        own = trials[trials["system"] == system]
        if len(own):
            found[system] = Table(f"Mean cost, cart-pole {label}", _costs(own, last))
    plain = Curves(trials[trials["system"] == "plain"], "cost")
    judged = {"planned": judge(TARGETS, plain, last)}
    found["targets"] = Table("Targets", claims_table("target", judged))
    found["seconds"] = Table("Seconds of a trial", _seconds(trials))
    return found


def _costs(own: pd.DataFrame, last: int) -> str:
    curves = Curves(own, "cost")
    names = [name for name in LEARNERS if name in curves.names]
    header = ["", "runs", *(f"trial {i}" for i in range(1, last + 1)), "worst of 3-5", "less CKA's"]
    rows = []
    for name in names:
        late = own[(own["scenario"] == name) & (own["episode"] >= 3)]["cost"]
        gap = curves.paired_difference(name, 2, last)
        cells = [number(curves.mean_at(name, i), ".3f") for i in range(1, last + 1)]
        cells += [number(late.max(), ".3f"), gap.text(".3f")]
        rows.append([LEARNERS[name], f"{len(curves.seeds(name))}", *cells])
    return markdown(header, rows)


def _seconds(trials: pd.DataFrame) -> str:
    medians = trials.groupby("scenario")[["plan_seconds", "fit_seconds", "cpu_seconds"]].median()
    rows = [
        [LEARNERS[name], *(number(value, ".1f") for value in medians.loc[name])]
        for name in LEARNERS
        if name in medians.index
    ]
    return markdown(["median of a trial", "plans, s", "fit, s", "CPU, s"], rows)


def _first(most: float, trial: int, curves: Curves) -> Finding:
    costs = curves.window("cka", trial, trial)
    return met(costs.mean() <= most), f"{costs.mean():.3f}, the worst run {costs.max():.3f}"


def _never_above(curves: Curves) -> Finding:
    own = curves.records[(curves.records["scenario"] == "cka")]
    late = own[own["episode"].between(3, 5)]["cost"]
    return met(late.max() <= 0.35), f"{late.max():.3f}, mean {late.mean():.3f}"


TARGETS = (
    Claim("T1", "mean cost at most .40 in trial 1, in f_p", ("cka",), lambda c: _first(0.4, 1, c)),
    Claim("T2", "mean cost at most .36 in trial 2", ("cka",), lambda c: _first(0.36, 2, c)),
    Claim("T3", "mean cost at most .29 in trial 3", ("cka",), lambda c: _first(0.29, 3, c)),
    Claim("T4", "no run above .35 in trials 3 to 5", ("cka",), _never_above),
)
