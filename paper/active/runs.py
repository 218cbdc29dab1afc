"""All learners on all problems with all seeds, in parallel processes, each resumable."""

from __future__ import annotations

import json
import time
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import torch
from botorch.exceptions.warnings import BadInitialCandidatesWarning, OptimizationWarning
from torch import Tensor

from gpadjust import fit
from gpadjust.active import collect
from gpadjust.active.refitting import refit
from gpadjust.validation import coverage, rmse
from paper.active.learners import LEARNERS, Learner
from paper.active.problems import Problem, problem
from paper.active.settings import SETTINGS, Settings
from paper.result_file import (
    check_settings,
    result_path,
    rounded,
    run_with_progress,
    versions,
    write_result,
)

Task = tuple[str, str, int]


def path_of(out: Path, name: str, learner: str, seed: int) -> Path:
    """The file of a finished run."""
    return result_path(out, f"{name}-{learner}", seed)


def run_one(
    name: str, learner: str, seed: int, out: Path, settings: Settings | None = None
) -> Path:
    """Measure with a learner, and score what it learns; nothing if the result is there.

    Args:
        name: The problem.
        learner: The learner.
        seed: Of the initial design, the physics where it is random, and the learner.
        out: Folder of the results. The log of an unfinished run lies in ``out/unfinished``.
        settings: Default: those of the problem.

    Returns:
        The path of the result, a JSON file.

    Raises:
        ValueError: If the result that is there is of other settings.
    """
    torch.set_num_threads(1)
    settings = SETTINGS[name] if settings is None else settings
    path, described = path_of(out, name, learner, seed), asdict(settings)
    if path.exists():
        check_settings(path, json.loads(path.read_text())["settings"], described)
        return path
    # Other settings have another log.
    mark = zlib.crc32(json.dumps(described).encode())
    log = out / "unfinished" / f"{path.stem}-{mark:08x}.jsonl"
    resumed, chosen_by = log.exists(), LEARNERS[learner]
    system = problem(name, seed)
    with _quiet():
        start = time.process_time()
        X = measured(system, chosen_by, settings, seed, log)
        between = time.process_time()
        scores = scored(system, chosen_by, settings, X)
    result = {
        "problem": name,
        "learner": learner,
        "seed": seed,
        "settings": described,
        "versions": versions(("gpadjust", "torch", "gpytorch", "botorch")),
        # What a run took before it was interrupted is not known.
        "choice_seconds": None if resumed else rounded(between - start),
        "score_seconds": rounded(time.process_time() - between),
        "scores": rounded(scores),
    }
    write_result(path, result)
    log.unlink(missing_ok=True)
    return path


def measured(system: Problem, learner: Learner, settings: Settings, seed: int, log: Path) -> Tensor:
    """The points that a learner measures, ``budget x d``, the initial design first."""
    initial, budget = settings.initial, settings.budget
    if learner.design == "sobol":
        return system.sobol(budget, seed)
    first = system.sobol(initial, seed)
    if learner.design == "random":
        return torch.cat([first, system.uniform(budget - initial, seed)])
    points = system.sobol(settings.integration_points, 10_000 + seed)
    acquisition = learner.acquisition
    assert acquisition is not None, "there is no design"
    collection = collect(
        partial(system.model, with_physics=learner.with_physics),
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


def scored(
    system: Problem, learner: Learner, settings: Settings, X: Tensor
) -> dict[str, list[float]]:
    """How well the learner's model predicts after each number of measurements in turn.

    Args:
        system: The problem.
        learner: The learner.
        settings: Its settings.
        X: The points in the order in which they were measured, ``budget x d``.

    Returns:
        For each of ``settings.counts()``: the error, in units of the truth's standard deviation
        (the root mean square over the outputs), and the coverage of the central 95 % interval.
    """
    Y, (test_X, test_Y) = system.truth(X), system.test_points(settings.num_test)
    sd, model = test_Y.std(0), None
    scores: dict[str, list[float]] = {"measurements": [], "nrmse": [], "coverage": []}
    for n in settings.counts():
        previous, model = model, system.model(X[:n], Y[:n], learner.with_physics)
        refit(model, previous, partial(fitted, settings))
        with torch.no_grad():
            mean, variance = model.predict(test_X, observation_noise=True)
        error = (rmse(mean, test_Y) / sd).square().mean().sqrt()
        scores["measurements"].append(n)
        scores["nrmse"].append(error.item())
        scores["coverage"].append(coverage(mean, variance, test_Y).mean().item())
    return scores


def fitted(settings: Settings, model: Any) -> None:
    """Fit a model from the hyper-parameters that it has and others."""
    fit(
        model,
        num_screened=settings.num_screened,
        num_starts=settings.num_starts,
        max_iterations=settings.max_iterations,
    )


def make_tasks(
    names: Sequence[str], learners: Sequence[str], num_runs: int, first_seed: int
) -> list[Task]:
    """All combinations, seed by seed, so that what is done first can be compared."""
    seeds = range(first_seed, first_seed + num_runs)
    return [(name, learner, seed) for seed in seeds for name in names for learner in learners]


def run_all(tasks: Sequence[Task], out: Path, num_jobs: int) -> None:
    """Run the tasks that have no result yet."""
    missing = [task for task in tasks if not path_of(out, *task).exists()]
    for task in (task for task in tasks if task not in missing):
        run_one(*task, out)  # checks its settings
    calls = [joblib.delayed(run_one)(*task, out.absolute()) for task in missing]
    run_with_progress(calls, len(tasks) - len(missing), num_jobs)


@contextmanager
def _quiet() -> Iterator[None]:
    """Leave out warnings of optimisations that stopped early, as the settings have it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=OptimizationWarning)
        warnings.filterwarnings("ignore", category=BadInitialCandidatesWarning)
        yield
