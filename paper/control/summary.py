"""What is written and printed of all runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pandas as pd

from paper.control.claims import Judged

FILES = ("table", "time", "claims")


@dataclass(frozen=True)
class Summary:
    """The tables of an experiment.

    Args:
        part: The column of ``table`` and ``claims`` that says which measure a row is about.
        table: A row for each measure and scenario.
        time: A row for each scenario: what it cost, and how well its model foresaw trials.
        claims: A row for each measure and claim, see :func:`verdicts`.
    """

    part: str
    table: pd.DataFrame
    time: pd.DataFrame
    claims: pd.DataFrame

    def write(self, out: Path) -> None:
        """Write each table into a CSV file of its name."""
        for name in FILES:
            getattr(self, name).to_csv(out / f"{name}.csv", index=False, float_format="%.4g")

    def show(self, title: str, digits: int) -> None:
        """Print the tables and verdicts, a measure after the other."""
        form = f"%.{digits}f"
        for name, rows in self.table.groupby(self.part, sort=False):
            print(f"\n{title}, {name}:")
            rows = rows.drop(columns=self.part)
            print(rows.to_string(index=False, float_format=form, na_rep="-"))
            for claim in self.claims[self.claims[self.part] == name].itertuples():
                print(f"  {claim.id} {claim.verdict}: {claim.claim} ({claim.measured})")
        print("\nOf a run:")
        print(self.time.to_string(index=False, float_format="%.4g", na_rep="-"))


def verdicts(part: str, judged: Mapping[str, Sequence[Judged]]) -> pd.DataFrame:
    """Claims as a table: a row for each measure, which the column ``part`` names, and claim."""
    return pd.DataFrame(
        [{part: name, **asdict(claim)} for name, claims in judged.items() for claim in claims]
    )
