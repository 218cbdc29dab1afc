"""The table of floors."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from paper.common.experiment import Record, Table
from paper.common.tables import markdown
from paper.floor import SYSTEMS, Floor

_WHAT = {
    SYSTEMS[0]: "cart-pole, mean start: cost of the best open loop found",
    SYSTEMS[1]: "cart-pole, fixed starts: cost of the best open loop found for each",
    SYSTEMS[2]: "arm: hand's error in cm, all steps, of SAC for long on the true arm, its best",
}


def tables(records: Sequence[Record], experiment: Floor) -> dict[str, Table]:
    """All tables, by name."""
    by_system = pd.DataFrame(records).groupby("system")["found"]
    rows = [
        [what, f"{len(found)}", *(f"{v:.3g}" for v in (found.mean(), found.min(), found.max()))]
        for system, what in _WHAT.items()
        if system in by_system.groups
        for found in [by_system.get_group(system)]
    ]
    return {"floors": Table("Floors", markdown(["", "runs", "mean", "least", "most"], rows))}
