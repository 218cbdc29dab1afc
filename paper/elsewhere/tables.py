"""Errors, shares held and widths of the runs that there are."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from paper.common.claims import Verdict, met
from paper.common.experiment import Record, Table
from paper.common.tables import markdown
from paper.elsewhere import HORIZONS, LEARNERS, TRAININGS, Elsewhere
from paper.elsewhere.systems import SYSTEMS
from paper.real.machines import STEP

_VARIATIONS = {"none": "", "found": " + variation found", "another": " + variation 0.2"}
_LEAST, _WIDEST = 0.85, 1.5
_CELL = ["training", "test", "learner", "variation", "steps", "angle"]


def load(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each angle and horizon of each test and variation of each run."""
    rows = []
    for record in records:
        for test, of_test in record["tests"].items():
            for variation, scores in of_test.items():
                for steps in map(str, HORIZONS):
                    values = zip(
                        *(scores[s][steps] for s in ("rmse", "held", "width")), strict=True
                    )
                    for angle, (rmse, held, width) in enumerate(values):
                        own = {k: record[k] for k in ("training", "learner", "seed")}
                        rows.append(
                            {**own, "test": test, "variation": variation, "steps": int(steps),
                             "angle": angle, "rmse": rmse, "held": held, "width": width}
                        )  # fmt: skip
    return pd.DataFrame(rows)


def tables(records: Sequence[Record], experiment: Elsewhere) -> dict[str, Table]:
    """All tables, by name."""
    runs = load(records)
    means = runs.groupby(_CELL)[["rmse", "held", "width"]].mean()
    rows = []
    for training, label in TRAININGS.items():
        for test, given in SYSTEMS[training].tests.items():
            for learner in LEARNERS:
                for variation, added in _VARIATIONS.items():
                    place = (training, test, learner, variation)
                    if (*place, HORIZONS[0], 0) not in means.index:
                        continue
                    cells = [
                        "/".join(f"{value:{form}}" for value in means.loc[(*place, steps), column])
                        for column, form in (("rmse", ".3f"), ("held", ".2f"), ("width", ".2f"))
                        for steps in HORIZONS
                    ]
                    rows.append([label, given.what, f"{LEARNERS[learner]}{added}", *cells])
    ahead = [f"{steps * STEP:g} s" for steps in HORIZONS]
    header = ["trained on", "tested at", "", *(f"RMSE {a}" for a in ahead)]
    header += [*(f"held {a}" for a in ahead), *(f"width {a}" for a in ahead)]
    title = "RMSE in rad, share held of 95 %, width by what would have held 95 % (by angle)"
    return {
        "targets": Table("Targets", markdown(["", "target", ""], _targets(means))),
        "scores": Table(title, markdown(header, rows)),
    }


def _targets(means: pd.DataFrame) -> list[list[str]]:
    """Of smoothed CKA with variation: what was found, and 0.2 of another machine."""
    own = means.reset_index()
    own = own[own["learner"] == "smoothed"]
    kinds = [
        SYSTEMS[training].tests[test].kind for training, test in own[["training", "test"]].values
    ]
    own = own.assign(kind=kinds)
    ours = own["variation"] == own["kind"].map(
        {"in range": "found", "beyond": "found", "another machine": "another"}
    )
    rows = []
    for i, (kind, claim) in enumerate(
        (
            ("beyond", "beyond the training range"),
            ("another machine", "on another machine, variation 0.2"),
            ("in range", "in range"),
        )
    ):
        mine, before = (
            own[(own["kind"] == kind) & chosen] for chosen in (ours, own["variation"] == "none")
        )
        if mine.empty:
            continue
        low, wide = mine["held"] >= _LEAST, mine["width"] <= _WIDEST
        for j, (text, kept, column, base, alone) in enumerate(
            (
                (
                    f"{claim}: 95 % hold at least {_LEAST}",
                    low,
                    "held",
                    before["held"],
                    before["held"] >= _LEAST,
                ),
                (
                    f"{claim}: widths at most {_WIDEST} times what holds .95",
                    wide,
                    "width",
                    before["width"],
                    before["width"] <= _WIDEST,
                ),
            )
        ):
            verdict: Verdict = met(bool(kept.all()))
            number = (
                f"in {kept.sum()} of {len(kept)} cells, from {mine[column].min():.2f} to "
                f"{mine[column].max():.2f} (without variation in {alone.sum()}, {base.min():.2f} "
                f"to {base.max():.2f})"
            )
            rows.append([f"E{2 * i + j + 1}", text, f"**{verdict}**: {number}"])
    return rows
