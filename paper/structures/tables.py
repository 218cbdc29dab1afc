"""What CKA loses to the models that it contains, and RRA to CKA, cell by cell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from paper.calibration import label
from paper.common.claims import Judged, met
from paper.common.experiment import Record, Table
from paper.common.tables import claims_table, markdown
from paper.structures import CELLS, GROUPS, LABELS, MODELS, Structures

MOST_RMSE = 1.1  # in those of the better of physics mean and GP
MOST_NLPD = 0.15  # nats above the better of them
CELLS_HELD = 0.9  # the share in which CKA is to hold both
MOST_RRA = 1.15  # of RRA's RMSE in CKA's, in the mean
_CONTAINED = ["phy", "gp"]
_CELL = ["problem", "size", "noise"]


def load(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each run."""
    left = ("settings", "versions", "each", "power", "effective_size")
    return pd.DataFrame([{k: v for k, v in r.items() if k not in left} for r in records])


def cells(records: Sequence[Record]) -> pd.DataFrame:
    """A row for each cell that all models have run in.

    Columns ``"label"``, ``"group"``, ``"seeds"``, their number, and ``"best"``, the better one's
    RMSE of physics mean and GP; then ``(score, model)`` of ``"nrmse"``, the median over the seeds
    in units of that, ``"nlpd"``, the mean less the better one's, ``"coverage"`` and ``"warned"``,
    means, and ``"seconds"``, a median.
    """
    runs = load(records)
    by_cell = runs.groupby([*_CELL, "model"], sort=False)
    middle = by_cell[["nrmse", "seconds"]].median().unstack()
    mean = by_cell[["nlpd", "coverage", "warned"]].mean().unstack()
    found = pd.concat([middle, mean], axis=1).dropna()
    order = dict.fromkeys([*CELLS, *found.index])  # beside the known ones those of smaller trials
    found = found.loc[[cell for cell in order if cell in found.index]]
    best = found["nrmse"][_CONTAINED].min(axis=1)
    least = found["nlpd"][_CONTAINED].min(axis=1)
    for model in MODELS:
        found["nrmse", model] /= best
        found["nlpd", model] -= least
    sizes = runs.groupby(_CELL, sort=False).agg(N=("N", "first"), seeds=("seed", "nunique"))
    sizes = sizes.reindex(found.index)
    found["seeds"], found["best"] = sizes["seeds"], best
    found["group"] = [GROUPS[name] for name, *_ in found.index]
    found["label"] = [
        label(name, n, noise) for (name, _, noise), n in zip(found.index, sizes["N"], strict=True)
    ]
    return found


def tables(records: Sequence[Record], experiment: Structures) -> dict[str, Table]:
    """All tables, by name."""
    found = cells(records)
    return {
        "targets": Table("Targets", claims_table("target", {"": verdicts(found)})),
        "summary": Table("CKA beside the better of physics mean and GP", summary(found)),
        "nrmse": Table(
            "Median RMSE / that of the better of physics mean and GP",
            _by_model(found, "nrmse", ".2f", MOST_RMSE),
        ),
        "nlpd": Table(
            "Mean NLPD less that of the better of physics mean and GP, nats",
            _by_model(found, "nlpd", "+.2f", MOST_NLPD),
        ),
        "coverage": Table("Mean coverage of 95 %", _by_model(found, "coverage", ".2f")),
        "seconds": Table("Median seconds of a fit", _by_model(found, "seconds", ".2g")),
    }


def verdicts(found: pd.DataFrame) -> list[Judged]:
    """Whether CKA loses to what it contains, and RRA to CKA."""
    rmse, nlpd = found["nrmse", "cka"], found["nlpd", "cka"]
    held = (rmse <= MOST_RMSE) & (nlpd <= MOST_NLPD)
    beyond = "; ".join(
        f"{name}: RMSE {error:.2f}, NLPD {density:+.2f}"
        for name, error, density in zip(
            found["label"][~held], rmse[~held], nlpd[~held], strict=True
        )
    )
    groups = {
        name: found[found["group"] == name] if name else found
        for name in ["", *dict.fromkeys(found["group"])]
    }
    ahead = {name: (_ratio(part), part["nlpd", "cka"].mean()) for name, part in groups.items()}
    rra = {name: _ratio(part, "rra", "cka") for name, part in groups.items()}
    return [
        Judged(
            "S1",
            f"CKA's RMSE at most {MOST_RMSE} times, and its NLPD at most {MOST_NLPD} nats above, "
            f"that of the better of physics mean and GP in at least {CELLS_HELD:.0%} of the cells",
            met(held.mean() >= CELLS_HELD),
            f"in {held.sum()} of {len(held)} ({held.mean():.0%})"
            + (f"; not in {beyond}" if beyond else ""),
        ),
        Judged(
            "S2",
            "CKA is ahead of the better of them in the mean",
            met(ahead[""][0] < 1 and ahead[""][1] < 0),
            "; ".join(
                f"{name}: " * bool(name) + f"RMSE {error:.2f} times, NLPD {density:+.2f}"
                for name, (error, density) in ahead.items()
            ),
        ),
        Judged(
            "S3",
            f"RRA's RMSE at most {MOST_RRA} times CKA's in the mean",
            met(rra[""] <= MOST_RRA),
            "; ".join(f"{name}: " * bool(name) + f"{ratio:.2f}" for name, ratio in rra.items()),
        ),
    ]


def _ratio(part: pd.DataFrame, model: str = "cka", other: str | None = None) -> float:
    """The geometric mean of RMSEs, in units of the better one of physics mean and GP, or other."""
    of = part["nrmse", model] / (1 if other is None else part["nrmse", other])
    return float(np.exp(np.log(of).mean()))


def summary(found: pd.DataFrame) -> str:
    """In how many cells CKA holds both limits, and the means, by group."""
    rows = []
    for name in [*dict.fromkeys(found["group"]), "all"]:
        part = found if name == "all" else found[found["group"] == name]
        close = part["nrmse", "cka"] <= MOST_RMSE
        sure = part["nlpd", "cka"] <= MOST_NLPD
        geometric = np.exp(np.log(part["nrmse"]).mean())
        rra = _ratio(part, "rra", "cka")
        rows.append(
            [
                name,
                f"{(close & sure).sum()} of {len(part)} ({(close & sure).mean():.0%})",
                f"{close.sum()}",
                f"{sure.sum()}",
                *(f"{geometric[model]:.2f}" for model in MODELS),
                *(f"{part['nlpd', model].mean():+.2f}" for model in MODELS),
                f"{part['coverage', 'cka'].mean():.3f}",
                f"{rra:.2f}",
            ]
        )
    head = ["cells", "CKA holds both limits", f"RMSE to {MOST_RMSE}", f"NLPD to +{MOST_NLPD}"]
    head += [f"RMSE, {LABELS[model]}" for model in MODELS]
    head += [f"NLPD, {LABELS[model]}" for model in MODELS]
    return markdown([*head, "CKA: 95 % hold", "RMSE, RRA / CKA"], rows)


def _by_model(found: pd.DataFrame, column: str, how: str, most: float | None = None) -> str:
    """A row for each cell; what of CKA is beyond the limit is bold."""
    rows = []
    for i, cell in enumerate(found["label"]):
        values = [(model, found[column, model].iloc[i]) for model in MODELS]
        rows.append(
            [
                cell,
                *(
                    f"**{value:{how}}**"
                    if model == "cka" and most is not None and value > most
                    else f"{value:{how}}"
                    for model, value in values
                ),
            ]
        )
    return markdown(["", *(LABELS[model] for model in MODELS)], rows)
