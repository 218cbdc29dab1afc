"""The tables of the runs that there are, and the verdicts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from paper.common.claims import FEWEST, Judged, counted, met
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown
from paper.optimisation import LABELS, PROBLEMS, Optimisation

REFERENCE = "ax"
JUDGED = ("cka", "cka-few")
CLAIMS = {
    (name, learner): f"O{i + 1 + j * len(PROBLEMS)}"
    for j, learner in enumerate(JUDGED)
    for i, name in enumerate(PROBLEMS)
}


def load(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each run; the trials are infinite if it came to its end before it was near."""
    rows = [
        {
            **{name: r[name] for name in ("problem", "learner", "seed")},
            "trials": np.inf if r["trials"] is None else r["trials"],
            "seconds": r["seconds"] / len(r["regrets"]),
            "regret": np.inf if r["regrets"][-1] is None else r["regrets"][-1],
        }
        for r in records
    ]
    return _sorted(pd.DataFrame(rows))


def regrets(records: Sequence[Record], trials: int) -> pd.DataFrame:
    """A row for each run and trial; a run that ended stays at the regret that it ended with."""
    rows = []
    for r in records:
        found = [np.inf if each is None else each for each in r["regrets"]]
        found += [found[-1]] * (trials - len(found))
        key = {name: r[name] for name in ("problem", "learner", "seed")}
        rows += [{**key, "trial": i + 1, "regret": each} for i, each in enumerate(found)]
    return _sorted(pd.DataFrame(rows))


def tables(records: Sequence[Record], experiment: Optimisation) -> dict[str, Table]:
    """All tables, by name."""
    runs, most = load(records), experiment.settings.trials
    percent = f"{experiment.settings.regret:.0%}".replace("%", " %")
    judged = [each for learner in JUDGED for each in verdicts(runs, most, learner)]
    found = {"claims": Table("Targets", claims_table("target", {"": judged}))}
    found["trials"] = Table(
        f"Median of the trials to {percent} regret, the initial ones included; in brackets the "
        f"runs that came there within {most}, if not all did",
        _by_learner(runs, _count),
    )
    found["paired"] = Table(
        "Seeds with which a learner needs fewer trials than Ax's default / as many / more",
        _by_learner(runs, lambda part: _paired(runs, part)),
    )
    found["seconds"] = Table(
        "Median seconds of a trial's choice, the initial ones included",
        _by_learner(runs, lambda part: f"{part['seconds'].median():.2g}"),
    )
    return found


def verdicts(runs: pd.DataFrame, most: int, learner: str = "cka") -> list[Judged]:
    """Whether a learner needs at most half the trials of Ax's default, in the median."""
    judged = []
    for problem, part in runs.groupby("problem", sort=False):
        name: Any = problem
        text = f"{name}: {LABELS[learner]} needs at most half the trials of Ax's default"
        by_seed = part.pivot(index="seed", columns="learner", values="trials")
        both = by_seed.reindex(columns=[learner, REFERENCE]).dropna()
        if len(both) < FEWEST:
            judged.append(Judged(CLAIMS[name, learner], text, "not run", "too few runs of both"))
            continue
        own, reference = (float(np.median(both[each])) for each in (learner, REFERENCE))
        said = [f"{x:g}" if np.isfinite(x) else f"more than {most}" for x in (own, reference)]
        measured = f"{counted(len(both))}: {said[0]}, Ax's default {said[1]} (medians)"
        # Of a median beyond the last trial nobody knows the half, only the least that it can be.
        half = min(reference, most + 1) / 2
        verdict = met(own <= half)
        if own > half and not np.isfinite(reference):
            verdict = "inconclusive"
        judged.append(Judged(CLAIMS[name, learner], text, verdict, measured))
    return judged


def _by_learner(runs: pd.DataFrame, cell: Callable[[pd.DataFrame], str]) -> str:
    """A row for each learner, a column for each problem."""
    problems = list(runs["problem"].unique())
    rows = []
    for learner, own in runs.groupby("learner", sort=False):
        parts = dict(iter(own.groupby("problem", sort=False)))
        rows.append(
            [LABELS[str(learner)], *(cell(parts[n]) if n in parts else "" for n in problems)]
        )
    return markdown(["", *problems], rows)


def _count(part: pd.DataFrame) -> str:
    middle, reached = float(np.median(part["trials"])), np.isfinite(part["trials"]).sum()
    text = f"{middle:g}" if np.isfinite(middle) else "never"
    return text if reached == len(part) else f"{text} ({reached} of {len(part)})"


def _paired(runs: pd.DataFrame, part: pd.DataFrame) -> str:
    reference = runs[
        (runs["learner"] == REFERENCE) & (runs["problem"] == part["problem"].iloc[0])
    ].set_index("seed")["trials"]
    own = part.set_index("seed")["trials"]
    shared = own.index.intersection(reference.index)
    if part["learner"].iloc[0] == REFERENCE or not len(shared):
        return ""
    own, reference = own[shared], reference[shared]
    counts = [(own < reference).sum(), (own == reference).sum(), (own > reference).sum()]
    return " / ".join(map(str, counts))


def _sorted(runs: pd.DataFrame) -> pd.DataFrame:
    ranks = {"problem": PROBLEMS.index, "learner": list(LABELS).index}
    order = [n for n in ("problem", "learner", "seed", "trial") if n in runs]
    return runs.sort_values(
        order, key=lambda c: c.map(ranks[str(c.name)]) if c.name in ranks else c
    ).reset_index(drop=True)
