"""Learn two tanks from the estimation record, choose by it, and follow the validation record."""

from __future__ import annotations

import math
import time
import warnings
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics, FreeRun, LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.inference import SamplingWarning
from gpadjust.models import CKA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.physics import Physics
from gpadjust.records import SmoothingWarning, smooth
from paper.common.experiment import Record
from paper.common.runner import run_one, runs_file
from paper.tanks import CANDIDATES, GPS, NARX, PROCESS_NOISE, TENTH, Settings, Tanks
from paper.tanks.systems import FULL, SPEC, START, levels, measured, outputs, physics

KEPT = 4  # of so many samples a free run keeps one, for the figure


class Start(NamedTuple):
    """The level of the upper tank at the beginning, the same in both records.

    Args:
        upper: In V.
        sd: Its standard deviation.
    """

    upper: float
    sd: float


class Fitted(NamedTuple):
    """An f_p that was fitted to a record.

    Args:
        physics: With the parameters that were found.
        values: These, by name.
        start: Where the upper tank was.
        noise: Standard deviations of what was measured.
        process_noise: Of what a step adds.
        settled: Whether the smoothing settled.
    """

    physics: Physics
    values: dict[str, float]
    start: Start
    noise: Tensor
    process_noise: Tensor
    settled: bool


def run(experiment: Tanks, learner: str, n: int, seed: int, *, unfinished: Path) -> Record:
    """Learn, choose where there is something to choose, and return the scores."""
    warnings.simplefilter("ignore", SamplingWarning)
    settings, begin = experiment.settings, time.perf_counter()
    actions, lower = measured("Est", settings.samples)
    if learner in NARX:
        found = _scores_of_narx(narx(NARX[learner], actions, lower, n, seed), settings)
    elif learner in GPS:
        by = chosen(experiment, "overflow" if learner.startswith("overflow") else "")
        begin = time.perf_counter()
        found = {"by": by["learner"], **_scores_of_gp(learner, by, n, seed, settings)}
    else:
        name = learner
        if learner == TENTH:
            name = chosen(experiment)["learner"]
            rows = torch.arange(len(lower))
            rows = (rows % 10 == seed % 10) & (rows < 10 * n)
            lower = lower.where(rows, torch.nan)
            begin = time.perf_counter()
        fitted = fit(name, actions, lower, settings)
        found = {"by": name, **_of_fit(fitted), **_scores_of_fit(fitted, settings)}
    found["seconds"] = time.perf_counter() - begin
    if learner not in CANDIDATES:
        del found["path"]  # of which there is no figure
    errors: list[float] = []
    if learner in CANDIDATES:
        errors = cross_validated(learner, settings)
    elif learner in NARX and seed == 0:
        errors = cross_validated_narx(NARX[learner], n, settings)
    if errors:
        found |= {"cv": math.sqrt(sum(e**2 for e in errors) / len(errors)), "blocks": errors}
    return found


def fit(candidate: str, actions: Tensor, lower: Tensor, settings: Settings) -> Fitted:
    """The parameters of f_p, and where the upper tank began, by all that was measured."""
    structure, _, scatter = candidate.partition("-")
    given: dict[str, Any] = {}
    if PROCESS_NOISE[scatter] is not None:
        given = {"process_noise": PROCESS_NOISE[scatter], "noise": (torch.nan, settings.noise)}
        given = {k: torch.tensor(sd, dtype=torch.float64) for k, sd in given.items()}
    records, unknown = levels(actions, lower), physics(structure)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", SmoothingWarning)
        found = smooth(
            records,
            unknown,
            start=START,
            num_starts=settings.starts,
            max_rounds=settings.rounds,
            **given,
        )
    mean = found.physics_parameters.mean.tolist()
    values = dict(zip(unknown.unknowns, mean, strict=True))
    start = Start(float(found.records.records[0].states[0, 0]), float(found.sd[0][0, 0]))
    noise = found.noise.nan_to_num()
    fixed = physics(structure, values)
    return Fitted(fixed, values, start, noise, found.process_noise, not said)


def cross_validated(candidate: str, settings: Settings) -> list[float]:
    """Errors of blocks that were left out of the fit, root mean squares in V."""
    actions, lower = measured("Est", settings.samples)
    errors = []
    for block in blocks(settings):
        fitted = fit(candidate, actions, without(lower, block), settings)
        path = follow(fitted.physics, fitted.start, actions, lower)
        errors.append(_error(path, lower, block))
    return errors


def cross_validated_narx(lags: int, n: int, settings: Settings) -> list[float]:
    """The same of a GP without f_p."""
    actions, lower = measured("Est", settings.samples)
    errors = []
    for block in blocks(settings):
        dynamics = narx(lags, actions, without(lower, block), n, seed=0)
        state = _held(dynamics, actions, lower)
        free = dynamics.free_run(state, actions[None, :-1, None], noise=False)
        errors.append(_error(_from_start(free.mean, lower, free.spec), lower, block))
    return errors


def narx(lags: int, actions: Tensor, lower: Tensor, n: int, seed: int) -> LearnedDynamics:
    """A GP without f_p, of what the sensor says."""
    records = outputs(actions, lower, lags)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Left out", UserWarning)
        data = records.trajectories()
    dynamics = LearnedDynamics(records.spec, model=ZeroMeanGP)
    dynamics.update(*data.spread(min(n, len(data.states)), seed))
    return dynamics


@cache
def smoothed(candidate: str, values: tuple[tuple[str, float], ...], samples: int) -> Any:
    """The states along the estimation record by an f_p with these parameters, both noises learnt.

    A fit with little process noise follows f_p so closely that there is nothing to learn about it.
    """
    records = levels(*measured("Est", samples))
    known = physics(candidate.partition("-")[0], dict(values))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        return known, smooth(records, known, start=START)


def chosen(experiment: Tanks, structure: str = "") -> Record:
    """The candidate, of all or of a structure, whose cross-validated error is the least."""
    settings, found = experiment.settings, []
    for name in CANDIDATES:
        if name.startswith(structure):
            task = (name, settings.samples, 0)
            if task not in runs_file(experiment).read():
                run_one(experiment, task)
            found.append(runs_file(experiment).read()[task])
    return min(found, key=lambda record: record["cv"])


def blocks(settings: Settings) -> list[slice]:
    """The blocks of the cross-validation."""
    edges = torch.linspace(settings.head, settings.samples, settings.blocks + 1).long().tolist()
    return [slice(*pair) for pair in pairwise(edges)]


def without(lower: Tensor, block: slice) -> Tensor:
    """Levels, but for those of a block."""
    lower = lower.clone()
    lower[block] = torch.nan
    return lower


def follow(known: Physics, start: Start, actions: Tensor, lower: Tensor) -> Tensor:
    """The level of the lower tank by an f_p alone, from the first that was measured."""
    dynamics = PhysicsDynamics(SPEC, known)
    function, state = dynamics.mean_function(), _state(start, lower)
    path = [state]
    for action in actions[:-1]:
        path.append(function(path[-1][None], action.view(1, 1, 1))[0])
    return torch.cat(path)[:, 1].clamp(0.0, FULL)


def _of_fit(fitted: Fitted) -> Record:
    return {
        "values": fitted.values,
        "start": list(fitted.start),
        "noise": fitted.noise.tolist(),
        "process_noise": fitted.process_noise.tolist(),
        "settled": fitted.settled,
    }


def _scores_of_fit(fitted: Fitted, settings: Settings) -> Record:
    """Of an f_p: by the path without noise, in intervals with all noise, but for parameters'."""
    actions, lower = measured("Val", settings.samples)
    dynamics = PhysicsDynamics(SPEC, fitted.physics)
    noise = {"noise": fitted.noise, "process_noise": fitted.process_noise}
    free = _with_start(dynamics, fitted.start, actions, lower, settings, **noise)
    return _scores(follow(fitted.physics, fitted.start, actions, lower), free, lower)


def _scores_of_gp(learner: str, by: Record, n: int, seed: int, settings: Settings) -> Record:
    """Of a GP beside an f_p whose parameters are those of a candidate."""
    known, found = smoothed(by["learner"], tuple(by["values"].items()), settings.samples)
    model = PhysicsMeanGP if learner.endswith("delta") else CKA
    dynamics = LearnedDynamics(SPEC, known, model=model)
    data = found.draw(seed).trajectories()
    dynamics.update(*data.spread(min(n, len(data.states)), seed))
    actions, lower = measured("Val", settings.samples)
    noise = {"noise": found.noise.nan_to_num(), "process_noise": "learnt"}
    free = _with_start(dynamics, Start(*by["start"]), actions, lower, settings, **noise)
    return _scores(_from_start(free.mean, lower, free.spec), free, lower)


def _scores_of_narx(dynamics: LearnedDynamics, settings: Settings) -> Record:
    actions, lower = measured("Val", settings.samples)
    free = dynamics.free_run(
        _held(dynamics, actions, lower),
        actions[None, :-1, None],
        num_functions=settings.num_functions,
        start_noise="learnt",
    )
    return _scores(_from_start(free.mean, lower, free.spec), free, lower)


def _with_start(
    dynamics: Dynamics,
    start: Start,
    actions: Tensor,
    lower: Tensor,
    settings: Settings,
    *,
    noise: Tensor,
    process_noise: Any,
) -> FreeRun:
    return dynamics.free_run(
        _state(start, lower),
        actions[None, :-1, None],
        num_functions=settings.num_functions,
        start_noise=torch.tensor([start.sd, float(noise[1])], dtype=torch.float64),
        noise=noise,
        process_noise=process_noise,
    )


def _state(start: Start, lower: Tensor) -> Tensor:
    """The first state ``1 x 2``: of the lower tank as measured."""
    return torch.tensor([[start.upper, float(lower[0])]], dtype=torch.float64)


def _held(dynamics: Dynamics, actions: Tensor, lower: Tensor) -> Tensor:
    """The first state of a GP without f_p: nothing changed before."""
    first = {"lower": lower[0], "pump": actions[0]}
    return torch.stack([first[name.partition("_")[0]] for name in dynamics.spec.states])[None]


def _from_start(mean: Tensor, lower: Tensor, spec: StateSpec) -> Tensor:
    """The level of the lower tank from the first that was measured, as the sensor says."""
    column = spec.states.index("lower")
    return torch.cat([lower[:1], mean[0, :, column]]).clamp(0.0, FULL)


def _error(path: Tensor, lower: Tensor, rows: slice) -> float:
    return float((path - lower)[rows].square().mean().sqrt())


def _scores(path: Tensor, free: FreeRun, lower: Tensor) -> Record:
    """Error in V and coverage after the first sample, and some of the path for the figure."""
    low, high = (_from_start(end, lower, free.spec) for end in (free.lower, free.upper))
    inside = (lower >= low - 1e-9) & (lower <= high + 1e-9)
    kept = {"mean": path, "lower": low, "upper": high}
    return {
        "rmse": _error(path, lower, slice(1, None)),
        "coverage": float(inside[1:].double().mean()),
        "width": float((high - low)[1:].mean()),
        "lost": float(free.lost[0, -1]),
        "path": {name: [round(v, 3) for v in x[::KEPT].tolist()] for name, x in kept.items()},
    }
