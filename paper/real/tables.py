"""Tables of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from paper.common.experiment import Record, Table
from paper.common.statistics import Difference
from paper.common.tables import claims_table, markdown, number
from paper.real import LEARNERS, SYSTEMS, UNTAUGHT, Real
from paper.real.machines import STEP
from paper.real.systems import system
from paper.real.targets import verdicts

SCORES = {"rmse": "RMSE of {angle} in rad", "coverage": "Coverage of 95 %", "nlpd": "NLPD in nats"}
_FORMS = {"rmse": ".3g", "coverage": ".2f", "nlpd": ".3g"}
_SECONDS = {"fit_seconds": "a fit", "score_seconds": "the scores"}
_FEWEST = 3  # draws that a spread is given of
_BASE, _PAIRED_N = "fitted", 100
_PAIRED = (
    ("double-pendulum", "near", "20"),
    ("double-pendulum", "far", "20"),
    ("pendulum", "sac", "10"),
)
_CELL = ["system", "test", "learner", "n"]


def load(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each test of each run.

    Columns beside those of the run are ``rmse-<steps>`` of the last angle, ``coverage-<steps>`` and
    ``nlpd-<steps>``, means over the states, and seconds. A learner that learns nothing has a row
    for each number of transitions that others have.
    """
    rows = []
    for record in records:
        angle = system(record["system"]).machine.spec.angle_columns[-1]
        run = {name: record[name] for name in ("system", "learner", "n", "seed", *_SECONDS)}
        for test, scores in record["tests"].items():
            values = {
                f"{name}-{steps}": np.array(of_states, dtype=float)  # None is NaN
                for name in SCORES
                for steps, of_states in scores[name].items()
            }
            of_angle = {
                k: v[angle] if k.startswith("rmse") else v.mean() for k, v in values.items()
            }
            rows.append({**run, "test": test, **of_angle})
    found = pd.DataFrame(rows)
    untaught = found["learner"].isin(UNTAUGHT)
    sizes = found.loc[~untaught, ["system", "n"]].drop_duplicates()
    everywhere = found[untaught].drop(columns="n").merge(sizes, on="system", how="left")
    everywhere = everywhere.fillna({"n": 0}).astype({"n": int})  # where no other was run
    return pd.concat([found[~untaught], everywhere], ignore_index=True)


def tables(records: Sequence[Record], experiment: Real) -> dict[str, Table]:
    """All tables, by name."""
    runs = load(records)
    means = runs.groupby(_CELL, sort=False).mean(numeric_only=True).drop(columns="seed")
    judged = {"means of the draws that there are": verdicts(means)}
    found = {"targets": Table("Targets", claims_table("target", judged))}
    found["paired"] = Table("n = 100, beside least squares by the same draws", _paired(runs))
    for (name, test), own in runs.groupby(["system", "test"], sort=False):
        of = f"{SYSTEMS[name]}, test {test}"
        for column in own.columns:
            score, _, steps = column.partition("-")
            if score in SCORES:
                angle = "the second angle" if name.startswith("double") else "the angle"
                title = f"{SCORES[score].format(angle=angle)} after {_ahead(steps)}, {of}"
                text = _by_learner(own, column, _FORMS[score])
                found[f"{name}-{test}-{column}"] = Table(title, text)
    for name, own in runs.groupby("system", sort=False):
        for column, what in _SECONDS.items():
            title = f"Seconds of {what}, {SYSTEMS[name]}"
            once = own[own["test"] == own["test"].iloc[0]]
            found[f"{name}-{column}"] = Table(title, _by_learner(once, column, ".2g"))
    return found


def _by_learner(own: pd.DataFrame, column: str, form: str) -> str:
    """Means over the runs with standard errors, by learner and number of transitions."""
    sizes, rows = sorted(own["n"].unique()), []
    for learner, label in LEARNERS.items():
        mine = own[own["learner"] == learner]
        if mine[column].notna().any():
            cells = [_cell(mine.loc[mine["n"] == n, column], form) for n in sizes]
            rows.append([label, *cells])
    return markdown(["", *(f"n = {n}" for n in sizes)], rows)


def _cell(values: pd.Series[float], form: str) -> str:
    """The mean, its standard error of three draws and more, and of how many it is."""
    found = Difference.of(values)
    if found.n < 2:
        return number(found.mean, form)
    error = "" if found.n < _FEWEST else f" ± {found.error:{'.1g' if form.endswith('g') else form}}"
    return f"{found.mean:{form}}{error} ({found.n})"


def _paired(runs: pd.DataFrame) -> str:
    """Errors of n = 100 beside those of least squares, by the same draws."""
    own = runs[runs["n"] == _PAIRED_N]
    header, rows = [""], []
    for _, test, steps in _PAIRED:
        header += [f"{test}, rad after {_ahead(steps)}", "by least squares', 95 %", "95 % hold"]
    for learner, label in LEARNERS.items():
        cells = []
        for name, test, steps in _PAIRED:
            of_test = own[(own["system"] == name) & (own["test"] == test)]
            by_seed = of_test[of_test["learner"] == learner].set_index("seed")
            other = of_test[of_test["learner"] == _BASE].set_index("seed")[f"rmse-{steps}"]
            errors = by_seed[f"rmse-{steps}"]
            if learner in UNTAUGHT and len(errors):  # one run, beside all draws
                errors = other * 0 + errors.iloc[0]
            ratio = Difference.of(np.log(errors / other) if learner != _BASE else [])
            said = "" if np.isnan(ratio.mean) else f"{np.exp(ratio.mean):.2f}"
            if ratio.n >= _FEWEST:
                said += f" [{np.exp(ratio.low):.2f}, {np.exp(ratio.high):.2f}]"
            held = by_seed[f"coverage-{steps}"].mean()
            draws = "" if learner in UNTAUGHT or not len(errors) else f" ({len(errors)})"
            cells += [number(errors.mean(), ".3f") + draws, said, number(held, ".2f")]
        if any(cells):
            rows.append([label, *cells])
    return markdown(header, rows)


def _ahead(steps: str) -> str:
    return "a step" if steps == "1" else f"{int(steps) * STEP:g} s"
