"""What the READMEs show of this experiment."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from paper.control.report import numbers, paired
from paper.exploration.results import MEASURES, SHOWN, WINDOWS
from paper.exploration.scenarios import EXPLORERS, INFORMATIVE, SCENARIOS
from paper.markdown import NOT_RUN, markdown

NAMES = ("curves", "seconds", *MEASURES)
_DIGITS = {"error": 3, "error_random": 3, "evaluation": 2}


def fragments(folder: Path) -> dict[str, str]:
    """The settings of the plans as they stand, and the results if there are any."""
    found = {"exploration:plans": _plans()}
    if not (folder / "table.csv").exists():
        return found | {f"exploration:{name}": NOT_RUN for name in NAMES}
    table, seconds = (pd.read_csv(folder / f"{name}.csv") for name in ("table", "seconds"))
    caption = "Error of the model and cost of the policy after each real trial; mean ± its error"
    found["exploration:curves"] = f"![{caption}](results/exploration/curves.png)"
    for measure, part in table.groupby("measure"):
        found[f"exploration:{measure}"] = _means(part, _DIGITS[str(measure)])
    seconds = seconds.set_index(seconds.pop("scenario").map(lambda name: SCENARIOS[name].label))
    header = ["of a run", "plans, s", "fits, s", "model steps, s", "updates, s", "CPU, s"]
    found["exploration:seconds"] = numbers(seconds, header, "{:.0f}")
    return found


def _plans() -> str:
    """The settings of informative trials."""
    rows = [[f"`{name}`", f"{value}"] for name, value in vars(INFORMATIVE).items()]
    return markdown(["setting", "value"], rows)


def _means(table: pd.DataFrame, digits: int) -> str:
    header = ["", "runs", *(f"after trial {trial}" for trial in SHOWN)]
    header += [f"{first}-{last}, less {EXPLORERS['sac'][0]}" for first, last in WINDOWS]
    rows = [
        [
            SCENARIOS[row["scenario"]].label,
            f"{row['runs']}",
            *("" if pd.isna(v) else f"{v:.{digits}f}" for v in (row[f"at_{t}"] for t in SHOWN)),
            *(paired(row, f"less_{first}_{last}", digits) for first, last in WINDOWS),
        ]
        for row in table.to_dict("records")
    ]
    return markdown(header, rows)
