"""Ways to choose where to measure, and what is learnt from it."""

from __future__ import annotations

import json
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from botorch.acquisition import AcquisitionFunction, qNegIntegratedPosteriorVariance
from botorch.acquisition.objective import ScalarizedPosteriorTransform
from botorch.exceptions.warnings import BadInitialCandidatesWarning, OptimizationWarning
from torch import Tensor

from gpadjust import fit
from gpadjust.active import collect, qAdjustmentInformationGain
from gpadjust.active.information_gain import About
from gpadjust.active.warm_refit import refit
from gpadjust.validation import coverage, rmse
from paper.active import Active, LearnerName, Settings
from paper.active.problems import Model, Problem, problem
from paper.common.experiment import Record

Acquisition = Callable[[Any, Tensor], AcquisitionFunction]


@dataclass(frozen=True)
class Learner:
    """A way to choose, and the model that learns.

    Args:
        model: What learns; None to believe f_p as it is, without a measurement.
        design: How the points are drawn if no model chooses them.
        acquisition: What a fitted model and integration points make; None for a design.
    """

    model: Model | None
    design: Literal["random", "sobol"] | None = None
    acquisition: Acquisition | None = None


def integrated_variance(model: Any, points: Tensor) -> AcquisitionFunction:
    """Minus the variance of f_a that would be left, averaged over points.

    Of several outputs the sum, each in units of the standard deviation of what was measured: as
    the outputs are independent, it is the variance of their sum in these units.
    """
    if model.num_outputs == 1:
        return qNegIntegratedPosteriorVariance(model, mc_points=points)
    measured, _ = model.outcome_transform.untransform(model.train_targets.mT)
    in_units = ScalarizedPosteriorTransform(1 / measured.std(0))
    return qNegIntegratedPosteriorVariance(model, mc_points=points, posterior_transform=in_units)


def information(model: Any, points: Tensor, about: About) -> AcquisitionFunction:
    """The information about the adjustments; it needs no points to integrate over."""
    return qAdjustmentInformationGain(model, about=about)


LEARNERS: dict[LearnerName, Learner] = {
    "f_p": Learner(None),
    "phy": Learner("physics mean", design="sobol"),
    "random": Learner("CKA", design="random"),
    "sobol": Learner("CKA", design="sobol"),
    "gp": Learner("GP", acquisition=integrated_variance),
    "cka": Learner("CKA", acquisition=integrated_variance),
    "both": Learner("CKA", acquisition=partial(information, about="both")),
    "rho": Learner("CKA", acquisition=partial(information, about="rho")),
}


def run(
    experiment: Active, name: str, learner: LearnerName, seed: int, *, unfinished: Path
) -> Record:
    """Measure with a learner, and score what it learns.

    Args:
        experiment: The experiment.
        name: The problem.
        learner: The learner.
        seed: Of the initial design, the physics where it is random, and the learner.
        unfinished: Beside it lies the log of the measurements, until the run is done.

    Returns:
        The scores, and the seconds that choices and scores took; those of choices are None if the
        run was interrupted.
    """
    settings = experiment.settings_of(name)
    # Other settings have another log.
    mark = zlib.crc32(json.dumps(asdict(settings)).encode())
    log = unfinished.with_name(f"{unfinished.name}-{mark:08x}.jsonl")
    resumed, chosen_by = log.exists(), LEARNERS[learner]
    system = problem(name, seed)
    if chosen_by.model is None:
        test_X, test_Y = system.test_points(settings.num_test)
        error = relative_error(system.physics(test_X), test_Y)
        scores: dict[str, list[Any]] = {"measurements": [0], "nrmse": [error], "coverage": [None]}
        return {"choice_seconds": 0.0, "score_seconds": 0.0, "scores": scores}
    with _quiet():
        start = time.process_time()
        X = measured(system, chosen_by, chosen_by.model, settings, seed, log)
        between = time.process_time()
        scores = scored(system, chosen_by.model, settings, X)
    log.unlink(missing_ok=True)
    return {
        "choice_seconds": None if resumed else between - start,
        "score_seconds": time.process_time() - between,
        "scores": scores,
    }


def measured(
    system: Problem, learner: Learner, kind: Model, settings: Settings, seed: int, log: Path
) -> Tensor:
    """The points that a learner measures, ``budget x d``, the initial design first."""
    initial, budget = settings.initial, settings.budget
    if learner.design == "sobol":
        return system.sobol(budget, seed)
    first = system.sobol(initial, seed)
    if learner.design == "random":
        return torch.cat([first, system.uniform(budget - initial, seed)])
    points = system.sobol(settings.integration_points, 10_000 + seed)
    acquisition = learner.acquisition
    if acquisition is None:
        raise ValueError("A learner needs a design or an acquisition function.")
    collection = collect(
        partial(system.model, kind=kind),
        system.truth,
        system.bounds,
        lambda model: acquisition(model, points),
        budget,
        initial=first,
        fit=partial(fitted, settings),
        optimizer_options={
            "raw_samples": settings.raw_samples,
            "num_restarts": settings.num_restarts,
            "options": {"maxiter": settings.maxiter},
        },
        log=log,
        seed=seed,
    )
    return collection.X


def scored(system: Problem, kind: Model, settings: Settings, X: Tensor) -> dict[str, list[Any]]:
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
    model = None
    scores: dict[str, list[Any]] = {"measurements": [], "nrmse": [], "coverage": []}
    for n in settings.counts():
        previous, model = model, system.model(X[:n], Y[:n], kind)
        refit(model, previous, partial(fitted, settings))
        with torch.no_grad():
            mean, variance = model.predict(test_X, observation_noise=True)
        scores["measurements"].append(n)
        scores["nrmse"].append(relative_error(mean, test_Y))
        scores["coverage"].append(coverage(mean, variance, test_Y).mean().item())
    return scores


def relative_error(mean: Tensor, truth: Tensor) -> float:
    """The root mean square over the outputs, each in units of the truth's standard deviation."""
    return (rmse(mean, truth) / truth.std(0)).square().mean().sqrt().item()


def fitted(settings: Settings, model: Any) -> None:
    """Fit a model from the hyper-parameters that it has and others."""
    fit(
        model,
        "map",
        num_screened=settings.num_screened,
        num_starts=settings.num_starts,
        max_iterations=settings.max_iterations,
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """Leave out warnings of optimisations that stopped early, as the settings have it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=OptimizationWarning)
        warnings.filterwarnings("ignore", category=BadInitialCandidatesWarning)
        yield
