"""What the READMEs show of this experiment."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from paper.active.learners import LABELS
from paper.active.settings import SETTINGS
from paper.markdown import NOT_RUN, markdown

NAMES = ("errors", "needed", "coverage", "seconds", "claims", "figure")


def fragments(folder: Path) -> dict[str, str]:
    """The settings as they stand, and the results if there are any."""
    found = {"active:settings": _settings()}
    if not (folder / "table.csv").exists():
        return found | {f"active:{name}": NOT_RUN for name in NAMES}
    table, claims = (pd.read_csv(folder / f"{name}.csv") for name in ("table", "claims"))
    seconds = table["choice_seconds"].map("{:.2g}".format)
    seconds += table["score_seconds"].map(" + {:.2g}".format)
    for name, cells in (
        ("errors", table["nrmse_median"].map("{:.2g}".format)),
        ("needed", table["needed"].map(_count)),
        ("coverage", table["coverage"].map("{:.2f}".format)),
        ("seconds", seconds),
    ):
        found[f"active:{name}"] = _by_learner(table.assign(cell=cells))
    rows = [[c.id, c.claim, f"**{c.verdict}**: {c.measured}"] for c in claims.itertuples()]
    found["active:claims"] = markdown(["", "target", ""], rows)
    caption = "Median and quartiles of the error over the number of measurements"
    found["active:figure"] = f"![{caption}](results/active/errors.png)"
    return found


def _settings() -> str:
    """A row for each setting, a column for each problem."""
    columns = [vars(settings) for settings in SETTINGS.values()]
    rows = [[f"`{name}`", *(f"{column[name]}" for column in columns)] for name in columns[0]]
    return markdown(["setting", *SETTINGS], rows)


def _by_learner(table: pd.DataFrame) -> str:
    """A row for each learner, a column for each problem."""
    cells = table.pivot(index="learner", columns="problem", values="cell").fillna("")
    problems = list(table["problem"].unique())
    rows = [
        [label, *cells.loc[name, problems]] for name, label in LABELS.items() if name in cells.index
    ]
    return markdown(["", *problems], rows)


def _count(number: float) -> str:
    """A number of measurements, in words where it is none."""
    if np.isnan(number):
        return ""
    return f"{number:g}" if np.isfinite(number) else "never"
