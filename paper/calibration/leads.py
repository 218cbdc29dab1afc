"""Priors that were tried for full Bayes, on data sets that are not reported.

`python -m paper.calibration.leads --seeds 100 101 102 103` prints the table.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import tyro
from tqdm import tqdm

from gpadjust.inference import targets
from gpadjust.models.parameters import KINDS
from paper.calibration import ROWS, Calibration

OTHERS: tuple[tuple[str, int, float], ...] = (
    ("six_hump_camelback", 5, 0.0),
    ("six_hump_camelback", 10, 0.0),
    ("six_hump_camelback", 6, 0.05),
    ("himmelblau", 5, 0.0),
    ("himmelblau", 10, 0.0),
    ("booth", 6, 0.05),
    ("park91b", 5, 0.0),
    ("currin", 8, 0.05),
)


class Lead(NamedTuple):
    """Medians and standard deviations of the logarithm, of log-normal priors, and the trend.

    Attributes:
        lengthscale: In ranges of the input, times the root of their number.
        outputscale: Of delta.
        rho: Of rho.
        noise: Of the noise.
        trend: Whether the size of a trend costs nothing.
    """

    lengthscale: tuple[float, float]
    outputscale: tuple[float, float]
    rho: tuple[float, float]
    noise: tuple[float, float]
    trend: bool = True


LEADS = {
    "the first priors": Lead(
        (math.exp(math.sqrt(2) - 1), math.sqrt(3)), (1.0, 5.0), (0.25, 1.5), (1e-4, 4.0), False
    ),
    "rho wide": Lead(
        (math.exp(math.sqrt(2) - 1), math.sqrt(3)), (1.0, 5.0), (0.01, 4.0), (1e-4, 4.0), False
    ),
    "all wide": Lead((10.0, 3.0), (1.0, 10.0), (0.01, 4.0), (1e-5, 5.0), False),
    "those of now, without the trend": Lead(
        (3.0, 2.0), (1.0, 6.0), (0.01, 4.0), (1e-3, 6.0), False
    ),
    "those of now": Lead((3.0, 2.0), (1.0, 6.0), (0.01, 4.0), (1e-3, 6.0)),
    "all wide, with the trend": Lead((10.0, 3.0), (1.0, 10.0), (0.01, 4.0), (1e-5, 5.0)),
}


@contextmanager
def taken(lead: Lead) -> Iterator[None]:
    """Let full Bayes have the priors of a lead for a while."""
    of_lead = {**lead._asdict(), "scaling": lead.rho}
    kinds = {
        kind: replace(KINDS[kind], prior=of_lead[kind])
        for kind in ("lengthscale", "outputscale", "scaling", "noise")
    }
    least = targets._LEAST if lead.trend else 10**9
    with patch.dict(KINDS, kinds), patch.object(targets, "_LEAST", least):
        yield


@dataclass(frozen=True)
class Leads:
    """The default under other priors."""

    seeds: tuple[int, ...] = (100, 101, 102, 103)
    """of the data sets"""
    leads: tuple[str, ...] = tuple(LEADS)
    """by name"""

    def __call__(self) -> None:
        """Print a row for each lead."""
        experiment, rows = Calibration(), (*ROWS, *OTHERS)
        bar = tqdm(total=len(self.seeds) * len(rows) * (1 + len(self.leads)))

        def scores(method: str) -> list[dict[str, float]]:
            found = []
            for row in rows:
                each = [
                    experiment.run(*row, method, seed, unfinished=Path()) for seed in self.seeds
                ]
                bar.update(len(each))
                found.append(
                    {k: float(np.mean([r[k] for r in each])) for k in ("coverage", "nlpd")}
                    | {"log": float(np.mean([math.log(r["nrmse"]) for r in each]))}
                )
            return found

        reference = scores("map")
        lines = ["| priors | 95 % hold | least of a row | NLPD | RMSE / that of the most likely |"]
        lines.append("| --- | --- | --- | --- | --- |")
        for name in self.leads:
            with taken(LEADS[name]):
                found = scores("default")
            cover = [row["coverage"] for row in found]
            gap = [row["log"] - own["log"] for row, own in zip(found, reference, strict=True)]
            lines.append(
                f"| {name} | {np.mean(cover):.3f} | {min(cover):.2f} | "
                f"{np.mean([row['nlpd'] for row in found]):.2f} | {math.exp(np.mean(gap)):.2f} |"
            )
        bar.close()
        print("\n".join(lines))


if __name__ == "__main__":
    tyro.cli(Leads)()
