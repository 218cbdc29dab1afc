"""What the READMEs show of this experiment."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from paper.cartpole.results import RMSES
from paper.cartpole.runs import CART_POLE
from paper.cartpole.scenarios import SCENARIOS
from paper.control.report import (
    claims_table,
    describe_settings,
    describe_updates,
    interval,
    model_table,
    numbers,
    paired,
)
from paper.markdown import NOT_RUN, markdown

NAMES = (
    "curves",
    "iqm",
    "seconds",
    "sampled",
    "deterministic",
    "claims",
    "targets",
    "time",
    "model",
    "short",
)
SHORT = ("mf-best", "phy", "gp", "cka", "rra", "oracle")  # the learners of the main README


def fragments(folder: Path) -> dict[str, str]:
    """The settings of the cart-pole as they stand, and its results if there are any."""
    found = {
        "cartpole:settings": describe_settings(CART_POLE),
        "cartpole:updates": describe_updates(CART_POLE),
    }
    if not (folder / "table.csv").exists():
        return found | {f"cartpole:{name}": NOT_RUN for name in NAMES}
    table, times, claims = (pd.read_csv(folder / f"{n}.csv") for n in ("table", "time", "claims"))
    for name, figure, caption in (
        ("curves", "curves", "Cost over the trials; the number of runs is in brackets"),
        ("iqm", "iqm", "Interquartile means of the cost; the number of runs is in brackets"),
        ("seconds", "time", "Seconds of a run"),
    ):
        found[f"cartpole:{name}"] = f"![{caption}](results/cartpole/{figure}.png)"
    for actions, part in table.groupby("actions"):
        found[f"cartpole:{actions}"] = _costs(part)
    found["cartpole:short"] = _short(table[table["actions"] == "sampled"])
    ours = claims["id"].str.startswith("T")
    parts = {name: f"{name} actions" for name in ("sampled", "deterministic")}
    found["cartpole:claims"] = claims_table(claims[~ours], "claim", "actions", parts)
    found["cartpole:targets"] = claims_table(claims[ours], "target", "actions", parts)
    times = times.set_index(times["scenario"].map(lambda name: SCENARIOS[name].label))
    columns = ["fit_seconds", "rollout_seconds", "sac_seconds", "total_seconds", "updates"]
    header = ["of a run", "fits, s", "model steps, s", "updates, s", "all, s", "updates"]
    found["cartpole:time"] = numbers(times[columns], header, "{:.0f}")
    errors = ("x, m", "theta, rad", "x', m/s", "theta', rad/s")
    found["cartpole:model"] = model_table(times, RMSES, errors)
    return found


def _costs(table: pd.DataFrame) -> str:
    header = ["", "runs", "trials 1-6", "at 6", "13-25", "41-50", "IQM of 41-50 (95 %)"]
    header += ["1-25, less Dyna-CKA's", "41-50, less Dyna-CKA's"]
    header += ["first at 0.5", "first at 0.4", "holds 0.5 from"]
    rows = []
    for row in table.to_dict("records"):
        costs = [row[f"cost_{name}"] for name in ("1_6", "6", "13_25", "41_50")]
        firsts = [row["first_0.5"], row["first_0.4"], row["holds_0.5"]]
        rows.append(
            [
                SCENARIOS[row["scenario"]].label,
                f"{row['runs']}",
                *("" if pd.isna(cost) else f"{cost:.2f}" for cost in costs),
                "" if pd.isna(row["iqm"]) else interval(row),
                *(paired(row, f"more_{trials}") for trials in ("1_25", "41_50")),
                *("never" if pd.isna(first) else f"{first:.0f}" for first in firsts),
            ]
        )
    return markdown(header, rows)


def _short(table: pd.DataFrame) -> str:
    header = ["mean cost of trials", "1-6", "at 6", "13-25", "41-50", "first at 0.5"]
    rows = []
    for row in table[table["scenario"].isin(SHORT)].to_dict("records"):
        costs = [row[f"cost_{name}"] for name in ("1_6", "6", "13_25", "41_50")]
        first = row["first_0.5"]
        rows.append(
            [
                SCENARIOS[row["scenario"]].label,
                *("" if pd.isna(cost) else f"{cost:.2f}" for cost in costs),
                "never" if pd.isna(first) else f"trial {first:.0f}",
            ]
        )
    return markdown(header, rows)
