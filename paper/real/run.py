"""Learn from some transitions of a machine; compare free runs with what was measured."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any

import torch

from gpadjust.dynamics import Dynamics, FreeRun, Windows
from gpadjust.inference import SamplingWarning
from paper.common.experiment import Record
from paper.real import HORIZONS, OF_STRETCHES, UNTAUGHT, Real, Settings
from paper.real.learners import Learnt, learnt, learnt_of_stretches
from paper.real.systems import System, system

_SHOWN = 2  # free runs that are kept for a figure


def run(
    experiment: Real, name: str, learner: str, n: int, seed: int, *, unfinished: Path
) -> Record:
    """Learn, and return the scores of each test: by steps ahead, of each state."""
    warnings.simplefilter("ignore", SamplingWarning)
    settings, known = experiment.settings, system(name)
    if learner in OF_STRETCHES:
        records = known.stretches(n, seed)
        begin = time.perf_counter()
        made = learnt_of_stretches(learner, known.machine, records, seed)
    else:
        data = known.drawn(n, seed)
        begin = time.perf_counter()
        made = learnt(learner, known.machine, data, seed)
    fitted = time.perf_counter()
    tests = {test: _scores(made, known, test, settings) for test in known.tests}
    found: Record = {
        "fit_seconds": fitted - begin,
        "score_seconds": time.perf_counter() - fitted,
        "tests": {test: scores for test, (scores, _) in tests.items()},
    }
    if made.parameters is not None:
        ends = zip(*made.parameters.interval(), strict=True)
        found["parameters"] = {
            name: [low.item(), high.item()]
            for name, (low, high) in zip(made.parameters, ends, strict=True)
        }
    if learner in UNTAUGHT or (n == settings.drawn and seed == 0):
        found["paths"] = {test: _paths(known, free) for test, (_, free) in tests.items()}
    return found


def _scores(
    made: Learnt, known: System, test: str, settings: Settings
) -> tuple[dict[str, Any], FreeRun]:
    """Scores by name and steps ahead, and the free runs of which they are.

    Those of one step are of all steps of the test. If the noise of what is measured is known, the
    dynamics learnt process noise; else half of what they learnt is that of a state (the windows
    start at measured ones), and there is no process noise.
    """
    (dynamics, noise, _), windows = made, windows_of(known, test, settings)
    if noise is None:
        single = dynamics.score(*known.steps(test))
        free = _follow(dynamics, windows, settings, start_noise="learnt")
    else:
        given: dict[str, Any] = {"start_noise": noise, "noise": noise, "process_noise": "learnt"}
        states, actions, following = known.steps(test)
        steps = Windows(states, actions.unsqueeze(1), following.unsqueeze(1))
        score = _follow(dynamics, steps, settings, **given).score(steps.measured)
        single = score[0]
        free = _follow(dynamics, windows, settings, **given)
    after = free.score(windows.measured)
    scores: dict[str, Any] = {}
    for name in ("rmse", "coverage", "nlpd"):
        found, ahead = getattr(single, name).tolist(), getattr(after, name).tolist()
        scores[name] = {"1": found, **{str(steps): ahead[steps - 1] for steps in HORIZONS}}
    return {**scores, "lost": free.lost[:, -1].mean().item()}, free


def _follow(dynamics: Dynamics, windows: Windows, settings: Settings, **given: Any) -> FreeRun:
    states, actions, _ = windows
    return dynamics.free_run(states, actions, num_functions=settings.num_functions, **given)


def windows_of(known: System, test: str, settings: Settings) -> Windows:
    """The windows of a test, the same for all learners."""
    return known.windows(test, HORIZONS[-1], settings.windows)


def _paths(known: System, free: FreeRun) -> dict[str, Any]:
    """A few free runs of the last angle: which windows they are, means and ends of intervals."""
    rows = torch.linspace(0, len(free.mean) - 1, _SHOWN + 2).round().long()[1:-1].unique()
    angle = known.machine.spec.angle_columns[-1]
    parts = {"mean": free.mean, "lower": free.lower, "upper": free.upper}
    paths = {name: part[rows, :, angle].tolist() for name, part in parts.items()}
    return {"windows": rows.tolist(), **paths}
