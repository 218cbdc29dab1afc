"""Ways to choose where to measure, what is learnt from it, and the verdicts."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch
from botorch.acquisition import AcquisitionFunction, qNegIntegratedPosteriorVariance
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.exceptions.warnings import BadInitialCandidatesWarning, OptimizationWarning
from torch import Tensor

from gpadjust import fit
from gpadjust.active import collect, qAdjustmentInformationGain
from gpadjust.active.information_gain import About
from gpadjust.validation import Scores
from paper.common.experiment import Run, Table
from paper.common.tables import markdown, settings_table
from paper.measuring import Active, Settings
from paper.measuring.problems import Problem, problem

PROBLEMS, LABELS = Active.axes["problem"], Active.axes["learner"]
REFERENCE = "gp"  # whose final error the others are to reach
_SECONDS = ["choice_seconds", "score_seconds"]


@dataclass(frozen=True)
class Chooser:
    """A way to choose, and the model that learns.

    Args:
        model: What learns, of ``paper.common.learners``; None to believe f_p as it is, without a
            measurement.
        design: How the points are drawn if no model chooses them.
        acquisition: Of a fitted model and integration points; None for a design.
    """

    model: str | None
    design: Literal["random", "sobol"] | None = None
    acquisition: Callable[[Any, Tensor], AcquisitionFunction] | None = None


def integrated_variance(model: Any, points: Tensor) -> AcquisitionFunction:
    """Minus the variance of f_a that would be left, averaged over points.

    Of several outputs the sum, each in units of the standard deviation of what was measured: as
    the outputs are independent, it is the variance of their sum in these units.
    """
    if model.num_outputs == 1:
        return qNegIntegratedPosteriorVariance(model, mc_points=points)
    in_units = ScalarizedPosteriorTransform(1 / model.data.Y.std(0))
    return qNegIntegratedPosteriorVariance(model, mc_points=points, posterior_transform=in_units)


def information(model: Any, points: Tensor, about: About) -> AcquisitionFunction:
    """The information about the adjustments; it needs no points to integrate over."""
    return qAdjustmentInformationGain(model, about=about)


CHOOSERS = {
    "f_p": Chooser(None),
    "phy": Chooser("phymean", design="sobol"),
    "random": Chooser("literal", design="random"),
    "sobol": Chooser("literal", design="sobol"),
    "gp": Chooser("gp", acquisition=integrated_variance),
    "cka": Chooser("literal", acquisition=integrated_variance),
    "both": Chooser("literal", acquisition=partial(information, about="both")),
    "rho": Chooser("literal", acquisition=partial(information, about="rho")),
}


def run(experiment: Active, name: str, learner: str, seed: int) -> Run:
    """Measure with a learner, and score what it learns.

    Args:
        experiment: The experiment.
        name: The problem.
        learner: The learner.
        seed: Of the initial design, the physics where it is random, and the learner.

    Returns:
        The scores, and the seconds that choices and scores took.
    """
    settings, chosen_by = experiment.settings_of(name), CHOOSERS[learner]
    system = problem(name, seed)
    if chosen_by.model is None:
        test_X, test_Y = system.test_points(settings.num_test)
        error = relative_error(system.physics(test_X), test_Y)
        scores: dict[str, list[Any]] = {"measurements": [0], "nrmse": [error], "coverage": [None]}
        return {"choice_seconds": 0.0, "score_seconds": 0.0, "scores": scores}
    with _quiet():
        start = time.process_time()
        X = measured(system, chosen_by, chosen_by.model, settings, seed)
        between = time.process_time()
        scores = scored(system, chosen_by.model, settings, X)
    return {
        "choice_seconds": between - start,
        "score_seconds": time.process_time() - between,
        "scores": scores,
    }


def measured(system: Problem, chooser: Chooser, kind: str, settings: Settings, seed: int) -> Tensor:
    """The points that are measured, ``budget x d``, the initial design first."""
    initial, budget = settings.initial, settings.budget
    if chooser.design == "sobol":
        return system.sobol(budget, seed)
    first = system.sobol(initial, seed)
    if chooser.design == "random":
        return torch.cat([first, system.uniform(budget - initial, seed)])
    points = system.sobol(settings.integration_points, 10_000 + seed)
    acquisition = chooser.acquisition
    if acquisition is None:
        raise ValueError("A chooser needs a design or an acquisition function.")
    collection = collect(
        partial(system.model, kind=kind),
        system.truth,
        system.bounds,
        lambda model: acquisition(model, points),
        budget,
        initial=first,
        fit=partial(fit, method="map"),
        optimizer_options={
            "raw_samples": settings.raw_samples,
            "num_restarts": settings.num_restarts,
            "options": {"maxiter": settings.maxiter},
        },
        seed=seed,
    )
    return collection.X


def scored(system: Problem, kind: str, settings: Settings, X: Tensor) -> dict[str, list[Any]]:
    """How well a model predicts after each number of measurements in turn.

    Args:
        system: The problem.
        kind: The model.
        settings: Of the problem.
        X: The points in the order in which they were measured, ``budget x d``.

    Returns:
        For each of ``settings.counts()``: the error, in units of the truth's standard deviation
        (the root mean square over the outputs), and the coverage of the central 95 % interval.
    """
    Y, (test_X, test_Y) = system.truth(X), system.test_points(settings.num_test)
    scores: dict[str, list[Any]] = {"measurements": [], "nrmse": [], "coverage": []}
    for n in settings.counts():
        model = system.model(X[:n], Y[:n], kind)
        fit(model, "map")
        with torch.no_grad():
            mean, variance = model.predict(test_X, observation_noise=True)
        scores["measurements"].append(n)
        scores["nrmse"].append(relative_error(mean, test_Y))
        coverage = Scores.of(mean, variance, test_Y).coverage
        scores["coverage"].append(coverage.mean().item())
    return scores


def relative_error(mean: Tensor, truth: Tensor) -> float:
    """The root mean square over the outputs, each in units of the truth's standard deviation."""
    error = (mean - truth).square().mean(0) / truth.var(0)
    return error.mean().sqrt().item()


@contextmanager
def _quiet() -> Iterator[None]:
    """Leave out warnings of optimisations that stopped early, as the settings have it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=OptimizationWarning)
        warnings.filterwarnings("ignore", category=BadInitialCandidatesWarning)
        yield


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """The scores: a row for each run and number of measurements."""
    key = ("problem", "learner", "seed", *_SECONDS)
    found = pd.concat(
        pd.DataFrame({**r["scores"], **{name: r[name] for name in key}}).astype(
            dict.fromkeys(["coverage", *_SECONDS], float)
        )
        for r in runs
    )
    ranks = {"problem": [*PROBLEMS].index, "learner": [*LABELS].index}
    return found.sort_values(
        ["problem", "learner", "seed", "measurements"],
        key=lambda c: c.map(ranks[str(c.name)]) if c.name in ranks else c,
    ).reset_index(drop=True)


def tables(runs: Sequence[Run], experiment: Active) -> dict[str, Table]:
    """All tables, by name."""
    scored = load(runs)
    table = tabulate(scored)
    seconds = table["choice_seconds"].map("{:.2g}".format)
    seconds += table["score_seconds"].map(" + {:.2g}".format)
    columns: dict[str, Any] = {
        problem: asdict(experiment.settings_of(problem)) for problem in PROBLEMS
    }
    found = {"settings": Table("Settings", settings_table(columns))}
    for name, title, cells in (
        ("errors", "Median final error", table["nrmse"].map("{:.2g}".format)),
        ("needed", "Measurements that reach the final error of `gp`", table.apply(_count, axis=1)),
        ("coverage", "Final coverage of 95 %", table["coverage"].map("{:.2f}".format)),
        ("seconds", "Seconds of choices + scores", seconds),
    ):
        found[name] = Table(title, _by_learner(table.assign(cell=cells.replace("nan", ""))))
    return found


def needed(runs: pd.DataFrame, learner: str) -> pd.Series[float]:
    """The measurements with which a learner first errs no more than the reference at its end.

    Args:
        runs: Of one problem.
        learner: The learner.

    Returns:
        A number for each seed that both have; infinity if it never does.
    """
    final = _final(runs, REFERENCE)["nrmse"]
    own = runs[(runs["learner"] == learner) & runs["seed"].isin(final.index)]
    numbers = {
        seed: part.loc[part["nrmse"] <= final[seed], "measurements"].min()
        for seed, part in own.groupby("seed")
    }
    return pd.Series(numbers, dtype=float).fillna(np.inf)


def tabulate(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each problem and learner; ``needed`` is infinite where it is never."""
    rows = []
    for (name, learner), part in runs.groupby(["problem", "learner"], sort=False):
        last = _final(part, str(learner))
        count = needed(runs[runs["problem"] == name], str(learner))
        rows.append(
            {
                "problem": name,
                "learner": learner,
                "nrmse": last["nrmse"].median(),
                "coverage": last["coverage"].mean(),
                "needed": np.median(count) if len(count) else np.nan,
                "reached": np.isfinite(count).sum(),
                "compared": len(count),
                **{seconds: last[seconds].median() for seconds in _SECONDS},
            }
        )
    return pd.DataFrame(rows)


def _final(runs: pd.DataFrame, learner: str) -> pd.DataFrame:
    """The last row of each run of a learner, by seed."""
    return runs[runs["learner"] == learner].groupby("seed").last()


def _by_learner(table: pd.DataFrame) -> str:
    """A row for each learner, a column for each problem."""
    cells = table.pivot(index="learner", columns="problem", values="cell").fillna("")
    problems = list(table["problem"].unique())
    rows = [
        [label, *cells.loc[name, problems]] for name, label in LABELS.items() if name in cells.index
    ]
    return markdown(["", *problems], rows)


def _count(row: pd.Series[float]) -> str:
    """A number of measurements, and in how many runs if not in all."""
    if np.isnan(row["needed"]):
        return ""
    text = f"{row['needed']:g}" if np.isfinite(row["needed"]) else "never"
    if row["reached"] in (row["compared"], 0):
        return text
    return f"{text} ({row['reached']} of {row['compared']})"
