"""One case: fit a model; are what is best, and what is true, in the intervals?"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from gpytorch.kernels import Kernel
from torch import Size, Tensor

from gpadjust import CKA, CalibratedPhysics, PhysicsMeanGP, fit
from gpadjust.gp import PhysicsScaledKernel
from gpadjust.inference import ParameterWarning, SamplingWarning
from gpadjust.models import TermsGP, orthogonal_rbf
from gpadjust.models.parameters import scaled_rbf
from gpadjust.validation import rmse
from paper.common.experiment import Record
from paper.parameters import Parameters
from paper.parameters.problems import case


def growing(num_inputs: int, batch_shape: Size) -> Kernel:
    """The kernel of a discrepancy that vanishes at 0 and grows as the input cubed."""
    return PhysicsScaledKernel(scaled_rbf(num_inputs, batch_shape), lambda X: X[..., :1] ** 3)


_BUILD: Mapping[str, Callable[..., TermsGP]] = {
    "physics": CalibratedPhysics,
    "free": PhysicsMeanGP,
    "orthogonal": partial(PhysicsMeanGP, covar_module=orthogonal_rbf),
    "cka": CKA,
    "vanishing": partial(PhysicsMeanGP, covar_module=growing),
}


def run(experiment: Parameters, problem: str, model: str, seed: int, *, unfinished: Path) -> Record:
    """Fit a model to a case; return ends of intervals, beside what they are to hold."""
    warnings.simplefilter("ignore", SamplingWarning)
    warnings.simplefilter("ignore", ParameterWarning)
    known = case(problem, seed)
    fitted: Any = _BUILD[model](known.X, known.observations, physics=known.physics)
    begin = time.perf_counter()
    fit(fitted)
    seconds = time.perf_counter() - begin
    low, high = fitted.physics_parameters.interval()
    with torch.no_grad():
        mean = fitted.predict(known.X).mean
        lower, upper = fitted.interval(known.X)
    return {
        "intervals": {
            name: [low[i].item(), high[i].item()] for i, name in enumerate(known.unknowns)
        },
        "best": known.best,
        "true": dict(known.true),
        "rmse": rmse(mean, known.system).item(),
        "coverage": _share((lower <= known.system) & (known.system <= upper)),
        "seconds": seconds,
    }


def _share(which: Tensor) -> float:
    return which.double().mean().item()
