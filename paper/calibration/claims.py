"""What this project set itself for its default fit, and for what `compare` recommends."""

from __future__ import annotations

import numpy as np
import pandas as pd

from paper.calibration import PUMP, ROWS, Calibration, label
from paper.common.claims import Judged, Verdict, met
from paper.common.runs_file import RunsFile
from paper.multifidelity import Multifidelity
from paper.structures import Structures

ROW = ["problem", "N", "noise"]
HOLD_95, LEAST_95, HOLD_50 = (0.92, 0.97), 0.85, (0.42, 0.60)
MEAN_RMSE, MOST_RMSE = 1.0, 1.3  # in those of the most likely
NLPD_BELOW, NLPD_ROWS, MOST_NLPD = 1.5, 11, 1.2
PUMP_HOLDS, PUMP_RMSE, WARNED = 0.90, 0.055, 0.02
MOST_TIME, FEW = 3.0, 50
CLOSE, CLOSE_ROWS = 1.15, 12
_MAP, _MFK = "map", "SMT MFK"


def targets(runs: pd.DataFrame, singles: pd.DataFrame) -> list[Judged]:
    """Verdicts on all targets.

    Args:
        runs: A row for each run.
        singles: RMSEs of other methods, as :func:`other_methods` reads them.
    """
    found = []
    for id, method, said, judged in (
        ("D", "default", "those of the default fit", _default),
        ("R", "compare", "those of what `compare` recommends", _recommended),
    ):
        own = runs[runs["method"] == method]
        known = _on_the_data_of(own, runs[runs["method"] == _MAP])
        if min(_kinds(own), _kinds(known)) < len(ROWS) + 1:
            found.append(Judged(id, said, "not run", "not all kinds of data sets were run"))
        else:
            found += judged(own, known, singles)
    return found


def other_methods(experiment: Calibration) -> pd.DataFrame:
    """RMSEs of single structures and of MFK, of the results that lie beside this experiment's.

    Columns as those of the runs: the row, ``"method"``, ``"seed"`` and ``"nrmse"``.
    """
    frames = [
        pd.DataFrame(RunsFile(folder / "runs.jsonl", kind.key).read().values())
        for kind in (Structures, Multifidelity)
        for folder in [experiment.out.parent / kind.name]
    ]
    columns = [*ROW, "method", "seed", "nrmse"]
    structures = frames[0].rename(columns={"model": "method"}).reindex(columns=columns)
    pairs = frames[1].assign(noise=0.0).rename(columns={"pair": "problem"})
    pairs = pairs.reindex(columns=columns)
    return pd.concat([structures, pairs[pairs["method"] == _MFK]])


def _default(own: pd.DataFrame, known: pd.DataFrame, singles: pd.DataFrame) -> list[Judged]:
    """Verdicts on the default fit; ``known`` are the most likely on the same data sets."""
    pump, warned = own[own["problem"] == PUMP], own["warned"]
    times = _by_row(own, "seconds", "median") / _by_row(known, "seconds", "median")
    times = times[times.index.get_level_values("N") <= FEW]
    own, known = (runs[runs["problem"] != PUMP] for runs in (own, known))
    data_set = [*ROW, "seed"]
    logs = np.log(own.set_index(data_set)["nrmse"] / known.set_index(data_set)["nrmse"])
    ratio = float(np.exp(logs.mean()))
    ratios = _by_row(own, "nrmse", "median") / _by_row(known, "nrmse", "median")
    gap = _by_row(own, "nlpd", "mean") - _by_row(known, "nlpd", "mean")
    holds, error = pump["coverage"].mean(), pump["nrmse"].median()
    return [
        *_coverage("D", own),
        Judged(
            "D4",
            f"RMSE / that of the most likely: at most {MEAN_RMSE}, geometric mean of the data sets",
            met(ratio <= MEAN_RMSE),
            f"{ratio:.2f}",
        ),
        Judged(
            "D5",
            f"the same of a row's medians: nowhere above {MOST_RMSE}",
            *_none(ratios[ratios > MOST_RMSE], ".2g"),
        ),
        Judged(
            "D6",
            f"NLPD: at least {NLPD_BELOW} nats below the most likely's, mean of the rows",
            met(gap.mean() <= -NLPD_BELOW),
            f"{-gap.mean():.1f} below; in the median row {-gap.median():.1f}",
        ),
        Judged(
            "D7",
            f"NLPD: lower in at least {NLPD_ROWS} rows",
            met((gap < 0).sum() >= NLPD_ROWS),
            f"in {(gap < 0).sum()} of {len(gap)}",
        ),
        Judged(
            "D8",
            f"NLPD: in no row higher by more than {MOST_NLPD}",
            *_none(gap[gap > MOST_NLPD], "+.2f"),
        ),
        Judged(
            "D9",
            f"pump: intervals of 95 % hold at least {PUMP_HOLDS:.2f}",
            met(holds >= PUMP_HOLDS),
            f"{holds:.3f}",
        ),
        Judged(
            "D10",
            f"pump: RMSE at most {PUMP_RMSE} (full Bayes, centre 0, before: 0.052)",
            met(error <= PUMP_RMSE),
            f"{error:.4f}, median of {len(pump)} data sets",
        ),
        Judged(
            "D11",
            f"warnings about the samples in at most {WARNED:.0%} of fits",
            met(max(warned.mean(), pump["warned"].mean()) <= WARNED),
            f"in {warned.sum()} of {len(warned)}, of the pump in {pump['warned'].sum()} of "
            f"{len(pump)}",
        ),
        Judged(
            "D12",
            f"time / that of the most likely: at most {MOST_TIME:g} for n <= {FEW}, medians",
            met(times.max() <= MOST_TIME),
            f"{times.min():.2f} to {times.max():.2f}",
        ),
    ]


def _recommended(own: pd.DataFrame, known: pd.DataFrame, singles: pd.DataFrame) -> list[Judged]:
    """Verdicts on what `compare` recommends, on fewer data sets."""
    own = own[own["problem"] != PUMP]
    singles = _on_the_data_of(own, pd.concat([singles, known]))
    errors = singles.groupby([*ROW, "method"])["nrmse"].median().unstack()
    text = f"RMSE: at most {CLOSE} times that of the best single method in at least {CLOSE_ROWS} "
    text += "rows; single are CKA, physics mean, GP and RRA by the default fit, the most likely "
    text += "CKA, and SMT's MFK where it is known"
    if not {"cka", _MFK} <= set(errors):
        last = Judged("R4", text, "not run", "no results of structures or multifidelity beside")
        return [*_coverage("R", own), last]
    middle = _by_row(own, "nrmse", "median")
    errors = errors.reindex(middle.index)
    ratios = middle / errors.min(axis=1)
    sampled = middle / errors.drop(columns=_MAP).min(axis=1)
    has_mfk = errors[_MFK].notna()
    measured = (
        f"in {(ratios <= CLOSE).sum()} of {len(ratios)}; without the most likely CKA in "
        f"{(sampled <= CLOSE).sum()} ({(sampled[has_mfk] <= CLOSE).sum()} of the {has_mfk.sum()} "
        f"rows where MFK is known); further off: {_named(ratios[ratios > CLOSE], '.4g')}"
    )
    verdict = met((ratios <= CLOSE).sum() >= CLOSE_ROWS)
    return [*_coverage("R", own), Judged("R4", text, verdict, measured)]


def _coverage(id: str, own: pd.DataFrame) -> list[Judged]:
    """Verdicts on intervals of 95 and of 50 %."""
    rows, half = _by_row(own, "coverage", "mean"), _by_row(own, "half", "mean")
    above = half[half > HOLD_50[1]]
    return [
        Judged(
            f"{id}1",
            f"intervals of 95 % hold {HOLD_95[0]:.2f} to {HOLD_95[1]:.2f}, mean of the rows",
            met(HOLD_95[0] <= rows.mean() <= HOLD_95[1]),
            f"{rows.mean():.3f}",
        ),
        Judged(
            f"{id}2",
            f"and in no row below {LEAST_95:.2f}",
            *_none(rows[rows < LEAST_95], ".3f"),
        ),
        Judged(
            f"{id}3",
            f"intervals of 50 % hold {HOLD_50[0]:.2f} to {HOLD_50[1]:.2f}, mean of the rows",
            met(HOLD_50[0] <= half.mean() <= HOLD_50[1]),
            f"{half.mean():.3f}; above: {_named(above, '.3f') or 'no row'}",
        ),
    ]


def _none(beyond: pd.Series[float], form: str) -> tuple[Verdict, str]:
    """Verdict and numbers of a target that no row is to miss, of those that do."""
    return met(beyond.empty), _named(beyond, form) or "none"


def _named(values: pd.Series[float], form: str) -> str:
    """Rows with their values."""
    named = values.items()
    return "; ".join(f"{label(*row)}: {value:{form}}" for row, value in named)


def _on_the_data_of(own: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Those of the runs whose data set some other runs had."""
    data_set = [*ROW, "seed"]
    return runs[runs.set_index(data_set).index.isin(own.set_index(data_set).index)]


def _by_row(runs: pd.DataFrame, column: str, how: str) -> pd.Series[float]:
    return runs.groupby(ROW, sort=False)[column].agg(how)


def _kinds(runs: pd.DataFrame) -> int:
    return runs.groupby(ROW).ngroups
