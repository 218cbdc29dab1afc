"""One case: fit a model, and set its intervals beside the true values and a reference."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, fit
from gpadjust.inference import SamplingWarning
from gpadjust.models import TermsGP, orthogonal_rbf
from paper.common.experiment import Record
from paper.ridges import FOLDS, NINE, Ridges
from paper.ridges.problems import Case, case
from paper.ridges.reference import Posterior, distance, ends, grid, sample

_BUILD: Mapping[str, Callable[..., TermsGP]] = {
    "physics": CalibratedPhysics,
    "free": PhysicsMeanGP,
    "orthogonal": partial(PhysicsMeanGP, covar_module=orthogonal_rbf),
    "cka": CKA,
}
_POINTS = {  # of grids
    "pendulum": (301, 901),
    "focus": (901, 301),
    "alias": (61, 2001),
    "radar": (61, 4001),
}


def run(experiment: Ridges, problem: str, model: str, seed: int, *, unfinished: Path) -> Record:
    """Fit a model to a case; what is returned is for each parameter, in their order."""
    known = case(problem, seed)
    fitted: Any = _BUILD[model](known.X, known.Y, physics=known.physics)
    begin = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result: Any = fit(fitted)
    seconds = time.process_time() - begin
    parameters = fitted.physics_parameters
    record: Record = {
        "true": known.true.tolist(),
        "interval": [end.tolist() for end in parameters.interval()],
        "size": result.effective_size.min().item(),
        "warned": any(issubclass(each.category, SamplingWarning) for each in caught),
        "seconds": seconds,
        "reference": None,
        "distance": None,
    }
    is_first = seed - experiment.seed < experiment.settings.compared
    if problem != NINE and (problem in FOLDS or is_first):
        z, weights = reference(problem, known, model, seed)
        values = known.physics.unknowns.at(z)
        record["reference"] = [end.tolist() for end in ends(values, weights)]
        record["distance"] = distance(parameters.draws, values, weights)
    return record


def reference(problem: str, known: Case, model: str, seed: int) -> tuple[Tensor, Tensor]:
    """Coordinates and weights that stand for the posterior."""
    if problem in FOLDS:
        return grid(known, _POINTS[problem])
    return sample(Posterior(known, model), seed)
