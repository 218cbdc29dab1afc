"""Learn from some records; compare free runs, and their intervals, with others."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any

import torch

from gpadjust import CKA
from gpadjust.dynamics import Dynamics, FreeRun, LearnedDynamics, Windows
from gpadjust.inference import SamplingWarning
from gpadjust.models import ZeroMeanGP
from gpadjust.records import smooth
from paper.common.experiment import Record
from paper.elsewhere import ANOTHER, HORIZONS, Elsewhere, Settings
from paper.elsewhere.systems import SYSTEMS
from paper.real.least_squares import LeastSquares


def run(
    experiment: Elsewhere, training: str, learner: str, seed: int, *, unfinished: Path
) -> Record:
    """Learn, and return scores by test, by variation, by steps ahead, of each angle."""
    warnings.simplefilter("ignore", SamplingWarning)
    settings, known = experiment.settings, SYSTEMS[training]
    records, machine = known.stretches(settings.n, seed), known.machine
    given: dict[str, Any] = {"start_noise": "learnt"}
    variations: dict[str, Any] = {"none": None}
    begin = time.perf_counter()
    dynamics: Dynamics
    if learner == "smoothed":
        found = smooth(records, machine.calibrated())
        records = found.draw(seed)
        given = {"start_noise": found.noise, "noise": found.noise, "process_noise": "learnt"}
        variations |= {"found": found.variation, "another": ANOTHER}
        dynamics = LearnedDynamics(machine.spec, machine.calibrated(), model=CKA)
    elif learner == "fitted":
        dynamics = LeastSquares(machine, machine.known["crude"])
    else:
        dynamics = LearnedDynamics(machine.spec, model=ZeroMeanGP)
    dynamics.update(*records.trajectories())
    seconds, tests = time.perf_counter() - begin, dict[str, Any]()
    for name, test in known.tests.items():
        windows, own = known.windows(name, HORIZONS[-1], settings.windows), variations
        if test.kind != "another machine":
            own = {kind: value for kind, value in variations.items() if kind != "another"}
        tests[name] = {}
        for kind, value in own.items():
            free = _follow(dynamics, windows, settings, **given, variation=value)
            tests[name][kind] = _scores(free, windows)
    found_variation = variations.get("found")
    return {
        "fit_seconds": seconds,
        "variation": None if found_variation is None else found_variation.tolist(),
        "tests": tests,
    }


def _follow(dynamics: Dynamics, windows: Windows, settings: Settings, **given: Any) -> FreeRun:
    states, actions, _ = windows
    return dynamics.free_run(states, actions, num_functions=settings.num_functions, **given)


def _scores(free: FreeRun, windows: Windows) -> dict[str, Any]:
    """Errors, shares held, and widths by what would have held 95 %: of each angle."""
    angles, rows = free.spec.angle_columns, [steps - 1 for steps in HORIZONS]
    error = free.spec.change(free.mean, windows.measured)[:, rows][..., angles]
    above, below = ((end - free.mean)[:, rows][..., angles] for end in (free.upper, free.lower))
    # How much wider, about the mean, an interval would have to be to reach what was measured.
    tiny = torch.finfo(error.dtype).tiny
    needed = torch.maximum(error / above.clamp_min(tiny), error / below.clamp_max(-tiny))
    found = {
        "rmse": error.square().mean(0).sqrt(),
        "held": ((error <= above) & (error >= below)).double().mean(0),
        "width": 1 / needed.quantile(0.95, dim=0),
    }
    return {
        name: dict(zip(map(str, HORIZONS), values.tolist(), strict=True))
        for name, values in found.items()
    }
