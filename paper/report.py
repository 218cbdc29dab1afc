"""Copies the committed results into the READMEs, between their markers."""

from __future__ import annotations

import re
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import pandas as pd

from paper.cartpole.results import RMSES
from paper.cartpole.scenarios import SCENARIOS, SETTINGS, Scenario, updates_on_trial

PAPER = Path(__file__).parent
READMES = (PAPER.parent / "README.md", PAPER / "README.md")

NOT_RUN = "No results yet."
SCORES = {
    "nrmse": "nrmse_median",
    "nlpd": "nlpd_median",
    "nlpd-mean": "nlpd_mean",
    "crps": "crps_median",
    "coverage": "coverage",
    "seconds": "seconds",
}
LOWER_IS_BETTER = ("nrmse_median", "nlpd_median", "nlpd_mean", "crps_median")


def report() -> None:
    """Write every result into the READMEs."""
    fragments = results(PAPER / "results")
    for path in READMES:
        path.write_text(filled(path.read_text(), fragments))


def filled(text: str, fragments: dict[str, str]) -> str:
    """Replace what stands between ``<!-- name -->`` and ``<!-- end -->`` by the fragments."""

    def fragment(match: re.Match[str]) -> str:
        name = match[1]
        if name not in fragments:
            raise ValueError(f"No result is called {name!r}; there are {sorted(fragments)}.")
        return f"<!-- {name} -->\n{fragments[name]}\n<!-- end -->"

    return re.sub(r"<!-- (?!end)(\S+) -->\n.*?<!-- end -->", fragment, text, flags=re.DOTALL)


def results(folder: Path) -> dict[str, str]:
    """All results as Markdown, by the names of their markers."""
    table = pd.read_csv(folder / "forrester" / "table.csv")
    claims = pd.read_csv(folder / "forrester" / "claims.csv")
    fragments = {"forrester:rmse": _rmse(table[table["reading"] == "B"])}
    for (reading, protocol), part in table.groupby(["reading", "protocol"]):
        fragments[f"forrester:{reading}:{protocol}"] = _scores(part)
    fragments["forrester:claims"] = _claims(claims[claims["reading"] == "B"])
    path = folder / "multifidelity" / "table.csv"
    pairs = pd.read_csv(path) if path.exists() else None
    for name, column in SCORES.items():
        fragments[f"multifidelity:{name}"] = NOT_RUN if pairs is None else _scores_of(pairs, column)
    fragments["multifidelity:short"] = NOT_RUN if pairs is None else _short(pairs)
    return fragments | _cartpole(folder / "cartpole")


def _cartpole(folder: Path) -> dict[str, str]:
    """The settings of the cart-pole as they stand, and its results if there are any."""
    fragments = {"cartpole:settings": _settings(), "cartpole:updates": _updates()}
    names = (
        "curves",
        "iqm",
        "seconds",
        "sampled",
        "deterministic",
        "claims",
        "targets",
        "time",
        "model",
    )
    if not (folder / "table.csv").exists():
        return fragments | {f"cartpole:{name}": NOT_RUN for name in names}
    table, times, claims = (pd.read_csv(folder / f"{n}.csv") for n in ("table", "time", "claims"))
    for name, figure, caption in (
        ("curves", "curves", "Cost over the trials; the number of runs is in brackets"),
        ("iqm", "iqm", "Interquartile means of the cost; the number of runs is in brackets"),
        ("seconds", "time", "Seconds of a run"),
    ):
        fragments[f"cartpole:{name}"] = f"![{caption}](results/cartpole/{figure}.png)"
    for actions, part in table.groupby("actions"):
        fragments[f"cartpole:{actions}"] = _costs(part)
    ours = claims["id"].str.startswith("T")
    fragments["cartpole:claims"] = _cartpole_claims(claims[~ours], "claim")
    fragments["cartpole:targets"] = _cartpole_claims(claims[ours], "target")
    times = times.set_index(times["scenario"].map(lambda name: SCENARIOS[name].label))
    columns = ["fit_seconds", "rollout_seconds", "sac_seconds", "total_seconds", "updates"]
    header = ["mean of a run", "fits, s", "model steps, s", "updates, s", "all, s", "updates"]
    fragments["cartpole:time"] = _numbers(times[columns], header, "{:.0f}")
    scores = times[["nlpd_median", "coverage", *RMSES, "left_bounds"]]
    scores = scores[scores[RMSES[0]].notna()]
    errors = ("x, m", "theta, rad", "x', m/s", "theta', rad/s")
    header = ["", "NLPD", "coverage of 95 %", *(f"RMSE of {e}" for e in errors), "particles lost"]
    fragments["cartpole:model"] = _numbers(scores, header, "{:.2g}")
    return fragments


def _settings() -> str:
    rows = [[f"`{name}`", f"{value}"] for name, value in vars(SETTINGS).items()]
    return _markdown(["setting", "value"], rows)


def _updates() -> str:
    """How many gradient steps each scenario makes after a trial."""

    def steps(scenario: Scenario, trial: int) -> str:
        real = updates_on_trial(scenario, SETTINGS, trial)
        if scenario.dynamics is None or trial > SETTINGS.model_until:
            return f"{real}"
        per_step = scenario.model_updates or SETTINGS.model_updates
        in_model = per_step * SETTINGS.model_trials * SETTINGS.trial_length
        return f"{real} + {in_model:.0f}"

    until = SETTINGS.model_until
    header = ["`--scenarios`", "", f"updates, trials 1-{until}", f"{until + 1}-", "seeds"]
    rows = [
        [
            f"`{name}`",
            scenario.label,
            steps(scenario, 1),
            steps(scenario, until + 1),
            f"{scenario.max_runs or 'all'}",
        ]
        for name, scenario in SCENARIOS.items()
    ]
    return _markdown(header, rows)


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
                "" if pd.isna(row["iqm"]) else _interval(row),
                *(_paired(row, f"behind_{trials}") for trials in ("1_25", "41_50")),
                *("never" if pd.isna(first) else f"{first:.0f}" for first in firsts),
            ]
        )
    return _markdown(header, rows)


def _interval(row: dict[Hashable, Any]) -> str:
    """An interquartile mean, with its interval if there are runs enough."""
    if pd.isna(row["iqm_low"]):
        return f"{row['iqm']:.2f}"
    return f"{row['iqm']:.2f} ({row['iqm_low']:.2f}, {row['iqm_high']:.2f})"


def _paired(row: dict[Hashable, Any], column: str) -> str:
    """A mean difference over shared seeds, with its standard error if there are two."""
    mean, error = row[column], row[f"{column}_se"]
    if pd.isna(mean):
        return ""
    return f"{mean:+.2f}" if pd.isna(error) else f"{mean:+.2f} ± {error:.2f}"


def _cartpole_claims(claims: pd.DataFrame, kind: str) -> str:
    rows = []
    for (name, claim), part in claims.groupby(["id", "claim"]):
        by_actions = part.set_index("actions")
        found = [
            f"**{by_actions['verdict'][a]}**: {by_actions['measured'][a]}"
            for a in ("sampled", "deterministic")
        ]
        if found[0] == found[1]:
            found[1] = "the same"
        rows.append([str(name), str(claim), *found])
    return _markdown(["", kind, "sampled actions", "deterministic actions"], rows)


def _numbers(table: pd.DataFrame, header: list[str], form: str) -> str:
    """A table of numbers, its index first."""
    rows = [
        [str(label), *("" if pd.isna(value) else form.format(value) for value in values)]
        for label, values in zip(table.index, table.to_numpy(), strict=True)
    ]
    return _markdown(header, rows)


def _rmse(table: pd.DataFrame) -> str:
    mean = table.pivot(index="model", columns="protocol", values="rmse_mean")
    median = table.pivot(index="model", columns="protocol", values="rmse_median")
    rows = [
        [name, *(f"{mean[p][name]:.3g} / {median[p][name]:.3g}" for p in ("paper", "gpadjust"))]
        for name in table["model"].unique()
    ]
    return _markdown(["mean / median RMSE", "paper's protocol", "`fit`"], rows)


def _scores(table: pd.DataFrame) -> str:
    header = ["", "RMSE mean", "sd", "median", "NLPD", "CRPS", "coverage", "fit, s"]
    columns = ["rmse_mean", "rmse_sd", "rmse_median", "nlpd", "crps", "coverage", "seconds"]
    rows = [
        [row["model"], *("" if pd.isna(row[c]) else f"{row[c]:.3g}" for c in columns)]
        for row in table.to_dict("records")
    ]
    return _markdown(header, rows)


def _claims(claims: pd.DataFrame) -> str:
    rows = []
    for (name, claim), part in claims.groupby(["id", "claim"]):
        by_protocol = part.set_index("protocol")
        found = [
            f"**{by_protocol['verdict'][p]}**: {by_protocol['measured'][p]}"
            for p in ("paper", "gpadjust")
        ]
        rows.append([str(name), str(claim), *found])
    return _markdown(["", "claim", "protocol paper", "protocol gpadjust"], rows)


def _scores_of(table: pd.DataFrame, column: str) -> str:
    """One score: a row for each pair and number of observations, a column for each method."""
    methods = list(table["method"].unique())
    rows = []
    for (name, N), part in table.groupby(["pair", "N"], sort=False):
        by_method = part.set_index("method")[column]
        rows.append([f"{name}, N = {N}", *_cells(by_method[methods], column in LOWER_IS_BETTER)])
    return _markdown(["", *methods], rows)


def _short(table: pd.DataFrame) -> str:
    """The median errors with 5 observations per input; coverage and time over all pairs."""
    table = table[table["per_input"] == 5]
    methods = list(table["method"].unique())
    rows = []
    for (name, N), part in table.groupby(["pair", "N"], sort=False):
        errors = part.set_index("method")["nrmse_median"]
        rows.append([f"{name}, N = {N}", *_cells(errors[methods], mark_best=True)])
    by_method = table.groupby("method")
    for label, values in (
        ("mean coverage of 95 %", by_method["coverage"].mean()),
        ("median seconds", by_method["seconds"].median()),
    ):
        rows.append([label, *_cells(values[methods], mark_best=False)])
    return _markdown(["median RMSE / sd", *methods], rows)


def _cells(values: pd.Series[float], mark_best: bool) -> list[str]:
    """Two digits of each value, the lowest in bold (and what looks the same)."""
    cells = [f"{value:.2g}" for value in values]
    best = f"{values.min():.2g}"
    return [f"**{cell}**" if mark_best and cell == best else cell for cell in cells]


def _markdown(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
