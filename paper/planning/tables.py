"""Tables and verdicts of the runs that there are."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial

import numpy as np
import pandas as pd

from paper.common.claims import Claim, Finding, judge, met
from paper.common.curves import Curves, load_trials
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown, number
from paper.planning import LEARNERS, SYSTEMS, Planning


def tables(records: Sequence[Record], experiment: Planning) -> dict[str, Table]:
    """All tables, by name."""
    trials, last = load_trials(records), experiment.settings.trials
    found, judged = {}, []
    for system, label in SYSTEMS.items():
        own = trials[trials["system"] == system]
        if len(own):
            text = _successes(own) if system == "mc-pilco" else _costs(own, last)
            found[system] = Table(f"Cart-pole {label}", text)
        if system in TARGETS:
            judged += judge(TARGETS[system], Curves(own, "cost"), last)
    if "plain" in found:
        text = found["plain"].text + "\n" + _of_dyna(experiment, last)
        found["plain"] = found["plain"]._replace(text=text.rstrip())
    found["short"] = Table("Mean cost of planned trials", _short(trials, last))
    found["targets"] = Table("Targets", claims_table("target", {"planned": judged}))
    found["seconds"] = Table("Seconds of a trial", _seconds(trials))
    return found


def _short(trials: pd.DataFrame, last: int) -> str:
    """The main README's table: each learner beside CKA, by the seeds that both have."""
    systems = [name for name in SYSTEMS if name != "mc-pilco" and (trials["system"] == name).any()]
    header = ["mean cost of trials 2-5", *(f"{SYSTEMS[name]}" for name in systems)]
    rows = []
    for learner, label in LEARNERS.items():
        cells = []
        for system in systems:
            own = trials[trials["system"] == system]
            curves = Curves(own, "cost")
            if learner == "cka":
                cost = number(curves.window("cka", 2, last).mean(), ".2f")
                cells.append(f"{cost} ({len(curves.seeds('cka'))} runs)")
            else:
                gap = curves.paired_difference(learner, 2, last)
                cells.append(f"{gap.text('.2f')} ({gap.n})" if gap.n else "")
        if any(cells):
            rows.append([label if learner == "cka" else f"{label}, less CKA's", *cells])
    return markdown(header, rows)


def _of_dyna(experiment: Planning, last: int) -> str:
    """Rows of the learners of the cart-pole's own experiment that have a model, if it was run."""
    path = experiment.out.parent / "cartpole" / "runs.jsonl"
    if not path.is_file():
        return ""
    runs = [json.loads(line) for line in path.read_text().splitlines()]
    rows = []
    for name, label in {"cka": "CKA", "phy": "f_p alone", "gp": "GP"}.items():
        costs = np.array([r["episodes"]["cost"] for r in runs if r["scenario"] == name])
        if not len(costs):
            continue
        cells = [number(each, ".3f") for each in costs[:, :last].mean(0)]
        worst = number(costs[:, 2:last].max(), ".3f")
        rows.append([f"DynaSAC, {label}", f"{len(costs)}", *cells, worst, ""])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def succeeded(trials: pd.DataFrame) -> pd.Series[bool]:
    """Whether pole and cart stay within 10 degrees and .1 m of the goal in the last second."""
    return (trials["last_lean"] <= 10) & (trials["last_offset"] <= 0.1)


def _successes(own: pd.DataFrame) -> str:
    """Of how many runs each trial succeeds; the first one is random."""
    own = own.assign(success=succeeded(own), episode=own["episode"] - 1)
    last = own["episode"].max()
    header = ["", "runs", *(f"trial {i}" for i in range(1, last + 1)), "mean cost of these"]
    rows = []
    for name in LEARNERS:
        mine = own[(own["scenario"] == name) & (own["episode"] >= 1)]
        if len(mine):
            counts = mine.groupby("episode")["success"].sum()
            cost = number(mine["cost"].mean(), ".3f")
            rows.append([LEARNERS[name], f"{mine['seed'].nunique()}", *map(str, counts), cost])
    return markdown(header, rows)


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


def _all_stand(trial: int, curves: Curves) -> Finding:
    """Whether all runs succeed in a trial after the random one."""
    own = curves.records[curves.records["scenario"] == "cka"]
    good = succeeded(own[own["episode"] == trial + 1])
    later = succeeded(own[own["episode"] > 1])
    text = f"{good.sum()} of {len(good)}; in all five trials {later.sum()} of {len(later)}"
    return met(bool(good.all())), text


TARGETS = {
    "plain": (
        Claim("T1", "mean cost at most .40 in trial 1, in f_p", ("cka",), partial(_first, 0.4, 1)),
        Claim("T2", "mean cost at most .36 in trial 2", ("cka",), partial(_first, 0.36, 2)),
        Claim("T3", "mean cost at most .29 in trial 3", ("cka",), partial(_first, 0.29, 3)),
        Claim("T4", "no run above .35 in trials 3 to 5", ("cka",), _never_above),
    ),
    "mc-pilco": (
        Claim(
            "T5",
            "in MC-PILCO's protocol all runs succeed in trial 2 (theirs by trial 4 or 5)",
            ("cka",),
            partial(_all_stand, 2),
        ),
    ),
}
