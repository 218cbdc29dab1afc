"""Shares held, widths and targets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from paper.common.claims import met
from paper.common.experiment import Record, Table
from paper.common.tables import markdown
from paper.kinks import KINKS, SMOOTH, Kinks


def tables(records: Sequence[Record], experiment: Kinks) -> dict[str, Table]:
    """All tables, by name."""
    runs = pd.DataFrame(
        {
            **{name: record[name] for name in ("system", "data", "n", "seconds")},
            "held": np.mean(record["held"]),
            "held_alone": np.mean(record["held_alone"]),
            "width": np.mean(np.log(np.divide(record["width"], record["width_alone"]))),
            "score": np.mean(np.log(np.divide(record["score"], record["score_alone"]))),
            "nlpd": np.mean(np.subtract(record["nlpd"], record["nlpd_alone"])),
            "error": np.mean(record["error"]),
        }
        for record in records
    )
    labels, rows = {**KINKS, **SMOOTH}, []
    present = [system for system in labels if system in {*runs["system"]}]
    for system in present:
        own = runs[runs["system"] == system]
        for i, ((data, n), group) in enumerate(own.groupby(["data", "n"])):
            rows.append(
                [
                    labels[system] if i == 0 else "",
                    str(data),
                    f"{n}",
                    f"{len(group)}",
                    f"{group['error'].median():.2g}",
                    f"{group['held_alone'].mean():.3f}",
                    f"{group['held'].mean():.3f}",
                    f"{np.exp(group['width'].mean()):.2f}",
                    f"{np.exp(group['score'].mean()):.2f}",
                    f"{group['nlpd'].median():+.2f}",
                    f"{group['seconds'].median():.2g}",
                ]
            )
    header = ["", "data", "n", "runs", "error / sd", "held, kernels alone", "held", "width"]
    header += ["interval score", "NLPD", "s"]
    return {
        "targets": Table("Targets", markdown(["", "target", ""], _targets(runs, present))),
        "intervals": Table("Intervals of 95 %", markdown(header, rows)),
    }


def _targets(runs: pd.DataFrame, present: Sequence[str]) -> list[list[str]]:
    """Verdicts, each on the worst system."""
    by = runs.groupby("system")
    held = {system: by.get_group(system)["held"].mean() for system in present}
    width = {system: np.exp(by.get_group(system)["width"].mean()) for system in present}
    kinks = [system for system in present if system in KINKS]
    smooth = [system for system in present if system in SMOOTH]
    found = []
    if kinks:
        numbers = ", ".join(f"{KINKS[s]} {held[s]:.2f}" for s in kinks)
        verdict = met(all(held[s] >= 0.9 for s in kinks))
        found.append(["K1", "each system with kinks: 95 % hold at least .90", verdict, numbers])
    if smooth:
        numbers = ", ".join(f"{SMOOTH[s]} {width[s]:.2f}" for s in smooth)
        verdict = met(all(width[s] <= 1.1 for s in smooth))
        text = "each smooth system: intervals at most 1.1 times as wide as by kernels alone"
        found.append(["K2", text, verdict, numbers])
    return [[name, text, f"**{verdict}**: {numbers}"] for name, text, verdict, numbers in found]
