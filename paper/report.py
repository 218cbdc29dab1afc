"""Copies the committed results into the READMEs, between their markers."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd

PAPER = Path(__file__).parent
READMES = (PAPER.parent / "README.md", PAPER / "README.md")


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
    return fragments


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


def _markdown(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
