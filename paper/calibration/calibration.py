"""Fits by a method of inference: what intervals hold, at what cost, and this project's targets."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import CKA, StackedGP, compare, fit
from gpadjust.models import TermsGP
from gpadjust.physics import Physics
from gpadjust.validation import score
from paper.calibration import METHODS, PUMP, ROWS, Calibration, label
from paper.common.experiment import Run, Table
from paper.common.runs import RunsFile, timed
from paper.common.tables import Cell, across, claims_table, frame, groups, of, table
from paper.common.verdicts import Judged, met
from paper.pairs import Multifidelity
from paper.pairs.functions import observations, pair
from paper.structures import Structures

_CHUNK = 50  # points predicted jointly, for the sake of memory
_ROW = ["problem", "N", "noise"]
_MAP, _MFK = "map", "SMT MFK"
# What this project set itself.
HOLD_95, LEAST_95, HOLD_50 = (0.92, 0.97), 0.85, (0.42, 0.60)
MEAN_RMSE, MOST_RMSE = 1.0, 1.3  # in those of the most likely
NLPD_BELOW, NLPD_ROWS, MOST_NLPD = 1.5, 11, 1.2
PUMP_HOLDS, PUMP_RMSE, WARNED = 0.90, 0.055, 0.02
MOST_TIME, FEW = 3.0, 50
CLOSE, CLOSE_ROWS = 1.15, 12


class Data(NamedTuple):
    """What a model learns from, and what it is scored at.

    Attributes:
        X: Inputs, ``n x d``.
        Y: Noisy observations, ``n x m``.
        physics: f_p.
        points: ``n' x d``.
        truth: The truth there, ``n' x m``.
        noise: The standard deviation of the noise of each output, ``m``.
    """

    X: Tensor
    Y: Tensor
    physics: Physics | Callable[[Tensor], Tensor]
    points: Tensor
    truth: Tensor
    noise: Tensor


def run(
    experiment: Calibration, problem: str, per_input: int, noise: float, method: str, seed: int
) -> Run:
    """Fit one data set; return scores of new observations, means over the outputs."""
    _prepare(method)
    if problem == PUMP[0]:
        data = pump(experiment.settings.num_pump, seed)
    else:
        data = of_pair(problem, per_input, noise, experiment.settings.num_test, seed)
    model, found = timed(lambda: fitted(data, method), time.perf_counter)
    found["warned"] = found["warned"] and method != "compare"
    scores = {name: each.mean().item() for name, each in scored(model, data, seed).items()}
    return {"N": len(data.X), **scores, **found}


def scored(model: TermsGP | StackedGP, data: Data, seed: int) -> dict[str, Tensor]:
    """Errors of the mean against the truth; density and coverage of new observations; ``m`` each.

    Args:
        model: Fitted to the data.
        data: What it is scored at; errors and densities are in standard deviations of the truth.
        seed: Of the data set.
    """
    generator = torch.Generator().manual_seed(seed + 1_000)
    new = data.noise * torch.randn(data.truth.shape, generator=generator, dtype=torch.float64)
    sd = data.truth.std(0)
    parts = zip(data.points.split(_CHUNK), (data.truth + new).split(_CHUNK), strict=True)
    with torch.no_grad():
        seen = [score(model.posterior(X, observation_noise=True), Y) for X, Y in parts]
        mean = torch.cat([model.predict(X).mean for X in data.points.split(_CHUNK)])
    sizes = torch.tensor([len(each.pit) for each in seen], dtype=torch.float64)
    nlpd = (torch.stack([each.nlpd for each in seen]) * sizes.unsqueeze(-1)).sum(0) / sizes.sum()
    away = (torch.cat([each.pit for each in seen]) - 0.5).abs()
    return {
        "nrmse": (mean - data.truth).square().mean(0).sqrt() / sd,
        "nlpd": nlpd - sd.log(),
        "coverage": (away <= 0.475).double().mean(0),
        "half": (away <= 0.25).double().mean(0),
    }


def of_pair(name: str, per_input: int, noise: float, num_test: int, seed: int) -> Data:
    """Observations of a pair of functions, with noise in standard deviations of the truth."""
    problem = pair(name)
    X, Y = observations(problem, per_input * problem.d, seed)
    test_X = problem.sobol(num_test, seed=0)
    test_Y = problem.truth(test_X)
    sd = noise * test_Y.std(0)
    generator = torch.Generator().manual_seed(seed + 2_000)
    Y = Y + sd * torch.randn(Y.shape, generator=generator, dtype=torch.float64)
    return Data(X, Y, problem.physics(), test_X, test_Y, sd)


def pump(n: int, seed: int) -> Data:
    """A centrifugal pump: pressure in Pa and flow in m3/s over speed in rpm and valve opening.

    The physics has the affinity laws with the catalogue's curve; the real pump leaks and is worn.
    """

    def curve(X: Tensor, wear: float, leak: float) -> Tensor:
        speed, valve = X[..., 0] / 3000, X[..., 1]
        resistance = 0.2 + (1 - valve).square() * 3
        flow = speed / (1 + resistance) ** 0.5
        head = speed.square() - wear * flow.square() - leak * speed * (1 - valve)
        return torch.stack([2.5e5 * head, 5e-3 * flow * (1 - leak * (1 - valve))], dim=-1)

    low, high = torch.tensor([1000.0, 0.1]).double(), torch.tensor([3000.0, 1.0]).double()
    generator = torch.Generator().manual_seed(seed)
    X = low + (high - low) * torch.rand(n, 2, generator=generator, dtype=torch.float64)
    noise = torch.tensor([2500.0, 5e-5], dtype=torch.float64)
    truth = curve(X, 0.55, 0.15)
    Y = truth + noise * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    axes = [torch.linspace(0, 1, 25, dtype=torch.float64)] * 2
    test_X = low + (high - low) * torch.cartesian_prod(*axes)
    return Data(X, Y, lambda X: curve(X, 0.3, 0.0), test_X, curve(test_X, 0.55, 0.15), noise)


def fitted(data: Data, method: str) -> TermsGP | StackedGP:
    """A model fitted by a method."""
    if method == "compare":
        return compare(data.X, data.Y, data.physics).recommended
    center: Any = 0.0 if method in (_MAP, "literal") else "learn"
    model = CKA(data.X, data.Y, physics=data.physics, center=center)
    options: Any = {"method": "map"} if method == _MAP else {}
    if method == "long":
        options = {"num_draws": 16_384, "num_samples": 128}
    fit(model, **options)
    return model


@cache
def _prepare(method: str) -> None:
    """Set a process up: one fit of the method that is not timed."""
    if method != "long":
        fitted(of_pair("forrester", 5, 0.0, 10, 4), method)


def tables(runs: Sequence[Run], experiment: Calibration) -> dict[str, Table]:
    """All tables, by name."""
    found = frame(runs)
    methods = {name: label for name, label in METHODS.items() if name in {*found["method"]}}
    judged = targets(found, other_methods(experiment))
    shown = {"targets": Table("Targets", claims_table("target", {"": judged}))}
    shown["summary"] = Table("All rows", _summary(found[found["problem"] != PUMP[0]], methods))
    for name, how, title in (
        ("coverage", "mean", "Mean coverage of the central 95 % interval"),
        ("half", "mean", "Mean coverage of the central 50 % interval"),
        ("nrmse", "median", "Median RMSE / sd of the truth"),
        ("nlpd", "mean", "Mean NLPD, nats, less the logarithm of the truth's sd"),
        ("seconds", "median", "Median seconds"),
    ):
        columns = across(found, "method", methods, of(name, how, ".2g"))
        shown[name] = Table(title, table(groups(found, _ROW, label), columns))
    return shown


def _summary(runs: pd.DataFrame, methods: dict[str, str]) -> str:
    """Over the rows: what this project set itself for its default."""
    logs = np.log(runs.pivot_table(index=[*_ROW, "seed"], columns="method", values="nrmse"))

    def rows(part: pd.DataFrame, column: str, how: str = "mean") -> pd.Series[float]:
        return part.groupby(_ROW, sort=False)[column].agg(how)

    def known(part: pd.DataFrame) -> pd.DataFrame:  # with the seeds of a method that may have fewer
        return runs[(runs["method"] == _MAP) & runs["seed"].isin({*part["seed"]})]

    def ratio(part: pd.DataFrame) -> str:
        gap = (logs[part["method"].iloc[0]] - logs[_MAP]).dropna()
        return f"{np.exp(gap.mean()):.2f}"

    def worst(part: pd.DataFrame) -> str:
        ratios = rows(part, "nrmse", "median") / rows(known(part), "nrmse", "median")
        return f"{ratios.max():.2g} ({(ratios > 1.3).sum()} above 1.3)"

    def gap(part: pd.DataFrame) -> pd.Series[float]:
        # Two means of the same numbers may differ in their last digit.
        return (rows(part, "nlpd") - rows(known(part), "nlpd")).round(9)

    def times(part: pd.DataFrame) -> pd.Series[float]:
        return rows(part, "seconds", "median") / rows(known(part), "seconds", "median")

    columns: dict[str, Cell] = {
        "95 % hold": lambda part: f"{rows(part, 'coverage').mean():.3f}",
        "least of a row": lambda part: f"{rows(part, 'coverage').min():.2f}",
        "50 % hold": lambda part: f"{rows(part, 'half').mean():.2f}",
        "NLPD": lambda part: f"{rows(part, 'nlpd').mean():.2f}",
    }
    if _MAP in methods:
        columns |= {
            "RMSE / that of the most likely": ratio,
            "largest of a row": worst,
            "NLPD lower in rows": lambda part: f"{(gap(part) < 0).sum()} of {len(gap(part))}",
            "largest loss of NLPD": lambda part: f"{gap(part).max():+.2f}",
            "time / that of the most likely": lambda part: f"{times(part).median():.1f}",
        }
    columns["share of warnings"] = lambda part: f"{rows(part, 'warned').mean():.3f}"
    return table(groups(runs, "method", methods), columns)


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
        if min(each.groupby(_ROW).ngroups for each in (own, known)) < len(ROWS) + 1:
            found.append(Judged(id, said, "not run", "not all kinds of data sets were run"))
        else:
            found += judged(own, known, singles)
    return found


def other_methods(experiment: Calibration) -> pd.DataFrame:
    """RMSEs of single structures and of MFK, of the results that lie beside this experiment's.

    Columns as those of the runs: the row, ``"method"``, ``"seed"`` and ``"nrmse"``.
    """
    structures, pairs = (
        pd.DataFrame(RunsFile(folder / "runs.jsonl", kind.key).read().values())
        for kind in (Structures, Multifidelity)
        for folder in [experiment.out.parent / kind.name]
    )
    columns = [*_ROW, "method", "seed", "nrmse"]
    structures = structures.rename(columns={"model": "method"}).reindex(columns=columns)
    pairs = pairs.assign(noise=0.0).rename(columns={"pair": "problem"}).reindex(columns=columns)
    return pd.concat([structures, pairs[pairs["method"] == _MFK]])


def _default(own: pd.DataFrame, known: pd.DataFrame, singles: pd.DataFrame) -> list[Judged]:
    """Verdicts on the default fit; ``known`` are the most likely on the same data sets."""
    pump, warned = own[own["problem"] == PUMP[0]], own["warned"]
    times = _by_row(own, "seconds", "median") / _by_row(known, "seconds", "median")
    times = times[times.index.get_level_values("N") <= FEW]
    own, known = (runs[runs["problem"] != PUMP[0]] for runs in (own, known))
    data_set = [*_ROW, "seed"]
    logs = np.log(own.set_index(data_set)["nrmse"] / known.set_index(data_set)["nrmse"])
    ratio = float(np.exp(logs.mean()))
    ratios = _by_row(own, "nrmse", "median") / _by_row(known, "nrmse", "median")
    gap = _by_row(own, "nlpd", "mean") - _by_row(known, "nlpd", "mean")
    holds, error = pump["coverage"].mean(), pump["nrmse"].median()
    return _coverage("D", own) + [
        Judged(f"D{number}", text, met(bool(held)), measured)
        for number, (text, held, measured) in enumerate(
            (
                (
                    f"RMSE / that of the most likely: at most {MEAN_RMSE}, geometric mean of the "
                    "data sets",
                    ratio <= MEAN_RMSE,
                    f"{ratio:.2f}",
                ),
                (
                    f"the same of a row's medians: nowhere above {MOST_RMSE}",
                    (ratios <= MOST_RMSE).all(),
                    _named(ratios[ratios > MOST_RMSE], ".2g") or "none",
                ),
                (
                    f"NLPD: at least {NLPD_BELOW} nats below the most likely's, mean of the rows",
                    gap.mean() <= -NLPD_BELOW,
                    f"{-gap.mean():.1f} below; in the median row {-gap.median():.1f}",
                ),
                (
                    f"NLPD: lower in at least {NLPD_ROWS} rows",
                    (gap < 0).sum() >= NLPD_ROWS,
                    f"in {(gap < 0).sum()} of {len(gap)}",
                ),
                (
                    f"NLPD: in no row higher by more than {MOST_NLPD}",
                    (gap <= MOST_NLPD).all(),
                    _named(gap[gap > MOST_NLPD], "+.2f") or "none",
                ),
                (
                    f"pump: intervals of 95 % hold at least {PUMP_HOLDS:.2f}",
                    holds >= PUMP_HOLDS,
                    f"{holds:.3f}",
                ),
                (
                    f"pump: RMSE at most {PUMP_RMSE} (full Bayes, centre 0, before: 0.052)",
                    error <= PUMP_RMSE,
                    f"{error:.4f}, median of {len(pump)} data sets",
                ),
                (
                    f"warnings about the samples in at most {WARNED:.0%} of fits",
                    max(warned.mean(), pump["warned"].mean()) <= WARNED,
                    f"in {warned.sum()} of {len(warned)}, of the pump in {pump['warned'].sum()} of "
                    f"{len(pump)}",
                ),
                (
                    f"time / that of the most likely: at most {MOST_TIME:g} for n <= {FEW}, "
                    "medians",
                    times.max() <= MOST_TIME,
                    f"{times.min():.2f} to {times.max():.2f}",
                ),
            ),
            start=4,
        )
    ]


def _recommended(own: pd.DataFrame, known: pd.DataFrame, singles: pd.DataFrame) -> list[Judged]:
    """Verdicts on what `compare` recommends, on fewer data sets."""
    own = own[own["problem"] != PUMP[0]]
    singles = _on_the_data_of(own, pd.concat([singles, known]))
    errors = singles.groupby([*_ROW, "method"])["nrmse"].median().unstack()
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
    above, below = half[half > HOLD_50[1]], rows[rows < LEAST_95]
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
            met(below.empty),
            _named(below, ".3f") or "none",
        ),
        Judged(
            f"{id}3",
            f"intervals of 50 % hold {HOLD_50[0]:.2f} to {HOLD_50[1]:.2f}, mean of the rows",
            met(HOLD_50[0] <= half.mean() <= HOLD_50[1]),
            f"{half.mean():.3f}; above: {_named(above, '.3f') or 'no row'}",
        ),
    ]


def _named(values: pd.Series[float], form: str) -> str:
    """Rows with their values."""
    named: Any = values.items()
    return "; ".join(f"{label(*row)}: {value:{form}}" for row, value in named)


def _on_the_data_of(own: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Those of the runs whose data set some other runs had."""
    data_set = [*_ROW, "seed"]
    return runs[runs.set_index(data_set).index.isin(own.set_index(data_set).index)]


def _by_row(runs: pd.DataFrame, column: str, how: str) -> pd.Series[float]:
    return runs.groupby(_ROW, sort=False)[column].agg(how)
