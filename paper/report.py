"""Copies the committed results into the READMEs, between their markers."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd

from paper.active.report import fragments as _active
from paper.arm.report import fragments as _arm
from paper.cartpole.report import fragments as _cartpole
from paper.exploration.report import fragments as _exploration
from paper.markdown import NOT_RUN, markdown

PAPER = Path(__file__).parent
READMES = (PAPER.parent / "README.md", PAPER / "README.md")

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
    for name, of_experiment in (
        ("cartpole", _cartpole),
        ("arm", _arm),
        ("active", _active),
        ("exploration", _exploration),
    ):
        fragments |= of_experiment(folder / name)
    return fragments


def _rmse(table: pd.DataFrame) -> str:
    mean = table.pivot(index="model", columns="protocol", values="rmse_mean")
    median = table.pivot(index="model", columns="protocol", values="rmse_median")
    rows = [
        [name, *(f"{mean[p][name]:.3g} / {median[p][name]:.3g}" for p in ("paper", "gpadjust"))]
        for name in table["model"].unique()
    ]
    return markdown(["mean / median RMSE", "paper's protocol", "`fit`"], rows)


def _scores(table: pd.DataFrame) -> str:
    header = ["", "RMSE mean", "sd", "median", "NLPD", "CRPS", "coverage", "fit, s"]
    columns = ["rmse_mean", "rmse_sd", "rmse_median", "nlpd", "crps", "coverage", "seconds"]
    rows = [
        [row["model"], *("" if pd.isna(row[c]) else f"{row[c]:.3g}" for c in columns)]
        for row in table.to_dict("records")
    ]
    return markdown(header, rows)


def _claims(claims: pd.DataFrame) -> str:
    rows = []
    for (name, claim), part in claims.groupby(["id", "claim"]):
        by_protocol = part.set_index("protocol")
        found = [
            f"**{by_protocol['verdict'][p]}**: {by_protocol['measured'][p]}"
            for p in ("paper", "gpadjust")
        ]
        rows.append([str(name), str(claim), *found])
    return markdown(["", "claim", "protocol paper", "protocol gpadjust"], rows)


def _scores_of(table: pd.DataFrame, column: str) -> str:
    """One score: a row for each pair and number of observations, a column for each method."""
    methods = list(table["method"].unique())
    rows = []
    for (name, N), part in table.groupby(["pair", "N"], sort=False):
        by_method = part.set_index("method")[column]
        rows.append([f"{name}, N = {N}", *_cells(by_method[methods], column in LOWER_IS_BETTER)])
    return markdown(["", *methods], rows)


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
    return markdown(["median RMSE / sd", *methods], rows)


def _cells(values: pd.Series[float], mark_best: bool) -> list[str]:
    """Two digits of each value, the lowest in bold (and what looks the same)."""
    cells = [f"{value:.2g}" for value in values]
    best = f"{values.min():.2g}"
    return [f"**{cell}**" if mark_best and cell == best else cell for cell in cells]
