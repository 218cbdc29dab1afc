"""Tables of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from paper.common.experiment import Record, Table
from paper.common.statistics import Difference
from paper.common.tables import claims_table, markdown, number
from paper.tanks import CANDIDATES, GPS, NARX, PROCESS_NOISE, STRUCTURES, TENTH, Tanks
from paper.tanks.systems import FIXED, UNKNOWNS
from paper.tanks.targets import PUBLISHED, verdicts

_SHOWN = ("learner", "n", "seed", "by", "cv", "rmse", "coverage", "width", "seconds", "settled")


def load(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each run, without parameters and paths."""
    return pd.DataFrame([{name: record.get(name) for name in _SHOWN} for record in records])


def chosen(runs: pd.DataFrame, among: Sequence[str]) -> str:
    """What has the least cross-validated error."""
    own = runs[runs["learner"].isin(among)].dropna(subset="cv").set_index("learner")["cv"]
    return str(own.astype(float).idxmin()) if len(own) else among[0]


def tables(records: Sequence[Record], experiment: Tanks) -> dict[str, Table]:
    """All tables, by name."""
    runs = load(records)
    best = chosen(runs, CANDIDATES)
    judged = {"one first sample of the record is used": verdicts(runs, best)}
    return {
        "targets": Table("Targets", claims_table("target", judged)),
        "candidates": Table("Structures and process noise", _candidates(runs, best)),
        "learners": Table("Free runs of the validation record", _learners(runs, best)),
        "parameters": Table("Parameters of the chosen f_p", _parameters(records, best)),
    }


def _candidates(runs: pd.DataFrame, best: str) -> str:
    """A row for each that was cross-validated."""
    rows = []
    for learner in (*CANDIDATES, *NARX):
        own = runs[(runs["learner"] == learner) & runs["cv"].notna()]
        for _, run in own.iterrows():
            label = label_of(learner)
            if learner in (best, chosen(runs, [*NARX])):
                label = f"**{label}**"
            unsettled = "" if run["settled"] in (None, True) else " (not settled)"
            cells = [number(run[name], ".3f") for name in ("cv", "rmse")]
            rows.append([f"{label}{unsettled}", _count(learner), *cells])
    return markdown(["", "parameters", "cross-validated, V", "validation, V"], rows)


def _learners(runs: pd.DataFrame, best: str) -> str:
    """A row for what was chosen, and for all that learns from fewer data or with a GP."""
    narx, rows = chosen(runs, [*NARX]), []
    bent = chosen(runs, [name for name in CANDIDATES if name.startswith("overflow")])
    for learner in (best, bent, TENTH, *GPS, narx):
        for n, own in runs[runs["learner"] == learner].groupby("n", sort=True):
            errors = own["rmse"].astype(float)
            cells = [_mean(errors, ".3f"), number(errors.max(), ".3f")]
            cells += [_mean(own[name], form) for name, form in _FORMS.items()]
            rows.append([label_of(learner, best), f"{n}", f"{len(own)}", *cells])
    rows += [[f"{name}, published", "", "", f"{e:.3f}", "", "", "", ""] for name, e in _SORTED]
    return markdown(
        ["", "n", "runs", "RMSE, V", "the worst", "coverage of 95 %", "width, V", "seconds"], rows
    )


_FORMS = {"coverage": ".2f", "width": ".2f", "seconds": ".2g"}
_SORTED = sorted(PUBLISHED.items(), key=lambda pair: -pair[1])


def _parameters(records: Sequence[Record], best: str) -> str:
    (record,) = [record for record in records if record["learner"] == best]
    values = {**record["values"], "upper level at first": record["start"][0]}
    priors = {name: known.prior_text for name, known in UNKNOWNS.items()}
    rows = [[f"`{name}`", f"{v:.3g}", priors.get(name, "5 ± 2")] for name, v in values.items()]
    return markdown(["", "value", "prior"], rows)


def label_of(learner: str, best: str = "") -> str:
    """What a learner is called."""
    if learner in CANDIDATES:
        structure, _, noise = learner.partition("-")
        sizes = PROCESS_NOISE[noise]
        known = "learnt" if sizes is None else ", ".join(f"{sd:g}" for sd in sizes)
        label = f"f_p: {STRUCTURES[structure]}; process noise {known}"
        return f"{label}, chosen" if learner == best else label
    if learner in NARX:
        lags = NARX[learner]
        return f"GP of {lags} level{'s' * (lags > 1)} and action{'s' * (lags > 1)}, no f_p"
    return "chosen f_p, every tenth sample" if learner == TENTH else GPS[learner]


def _count(learner: str) -> str:
    if learner in NARX:
        return ""
    return f"{len(UNKNOWNS) - len(UNKNOWNS.keys() & FIXED[learner.partition('-')[0]].keys())}"


def _mean(values: pd.Series[float], form: str) -> str:
    found = Difference.of(values.astype(float))
    if np.isnan(found.error):
        return number(found.mean, form)
    return f"{found.mean:{form}} ± {found.error:{'.1g' if form.endswith('g') else form}}"
