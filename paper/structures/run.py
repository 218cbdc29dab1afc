"""Fit a model to a data set by the library's defaults, and score what it predicts."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from botorch.exceptions.warnings import OptimizationWarning
from torch import Tensor

import gpadjust
from gpadjust import fit
from gpadjust.dynamics import LearnedDynamics
from gpadjust.inference import SampleResult, SamplingWarning
from gpadjust.models import TermsGP
from paper.calibration import PUMP
from paper.calibration.run import Data, of_pair, pump, scored
from paper.common.experiment import Record
from paper.structures import CLASSES, GROUPS, Model, Structures
from paper.structures.systems import System, system

_Fitted = TypeVar("_Fitted")


def run(
    experiment: Structures,
    problem: str,
    size: int,
    noise: float,
    model: Model,
    seed: int,
    *,
    unfinished: Path,
) -> Record:
    """Fit one model to one data set; return scores, those of each output in a list."""
    _prepare(model)
    settings = experiment.settings
    if GROUPS[problem] == "functions":
        if problem == PUMP:
            data = pump(settings.num_pump, seed)
        else:
            data = of_pair(problem, size, noise, settings.num_test, seed)
        return _of_function(data, model, seed)
    return _of_system(system(problem, size, settings.num_transitions, seed), model)


def _of_function(data: Data, name: Model, seed: int) -> Record:
    """Scores of each output, as those of calibration."""
    (model, sizes), found = _timed(lambda: _fitted(data, name))
    scores = scored(model, data, seed)
    return {
        "N": len(data.X),
        **_scores(scores["nrmse"], scores["nlpd"], scores["coverage"]),
        "effective_size": sizes,
        **found,
    }


def _fitted(data: Data, name: Model) -> tuple[TermsGP, list[float]]:
    given = {} if name == "gp" else {"physics": data.physics}
    model = getattr(gpadjust, CLASSES[name])(data.X, data.Y, **given)
    return model, _sizes(fit(model))


def _of_system(data: System, name: Model) -> Record:
    """Scores of each state's change in one step, as the mean and variance of dynamics tell it."""

    def learnt() -> LearnedDynamics:
        physics = None if name == "gp" else data.physics
        dynamics = LearnedDynamics(data.spec, physics, model=getattr(gpadjust, CLASSES[name]))
        dynamics.update(*data.train)
        return dynamics

    dynamics, found = _timed(learnt)
    scores = dynamics.score(*data.test)
    change = data.spec.change(data.test.states, data.test.next_states)[:, data.spec.moving]
    sd = change.std(0)
    return {
        "N": len(data.train.states),
        **_scores(scores.rmse / sd, scores.nlpd - sd.log(), scores.coverage),
        "effective_size": _sizes(dynamics.fit_result),
        **found,
    }


def _scores(nrmse: Tensor, nlpd: Tensor, coverage: Tensor) -> Record:
    """Over the outputs, and of each."""
    return {
        "nrmse": nrmse.log().mean().exp().item(),
        "nlpd": nlpd.mean().item(),
        "coverage": coverage.mean().item(),
        "each": {
            "nrmse": nrmse.tolist(),
            "nlpd": nlpd.tolist(),
            "coverage": coverage.tolist(),
        },
    }


def _sizes(result: Any) -> list[float]:
    """The effective sample size of the draws of each output."""
    return result.effective_size.reshape(-1).tolist() if isinstance(result, SampleResult) else []


def _timed(fitted: Callable[[], _Fitted]) -> tuple[_Fitted, Record]:
    """What a fit returns; its seconds, and whether it said that its draws are few."""
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = fitted()
    seconds = time.perf_counter() - start
    for each in caught:
        if not issubclass(each.category, OptimizationWarning | SamplingWarning):
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    warned = any(issubclass(each.category, SamplingWarning) for each in caught)
    return result, {"seconds": seconds, "warned": warned}


@cache
def _prepare(name: Model) -> None:
    """Set a process up: one fit that is not timed."""
    _fitted(of_pair("forrester", 5, 0.0, 10, 4), name)
