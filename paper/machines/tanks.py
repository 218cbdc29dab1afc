"""Learn two tanks from the estimation record, choose by it, and follow the validation record."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust.core import SamplingWarning
from gpadjust.dynamics import Dynamics, FreeRun, LearnedDynamics, PhysicsDynamics, StateSpec
from gpadjust.physics import Physics
from gpadjust.records import SmoothingWarning, smooth
from paper.common.experiment import Run, Table
from paper.common.learners import LEARNERS
from paper.common.tables import Cell, markdown, number, of, table
from paper.common.verdicts import Difference
from paper.machines import (
    CANDIDATES,
    CHOSEN,
    GPS,
    NARX,
    PROCESS_NOISE,
    TENTH,
    Tanks,
    TanksSettings,
)
from paper.machines.tanks_systems import (
    FIXED,
    FULL,
    SPEC,
    START,
    UNKNOWNS,
    levels,
    measured,
    outputs,
    physics,
)

PUBLISHED = {
    "linear": 0.588,
    "polynomial NARX": 0.413,
    "GRU": 0.396,
    "CT-SUBNET": 0.306,
    "grey box (Worden 2018)": 0.191,
}
"""Errors in V of free runs along the validation record."""

_KEPT = 4  # of so many samples a free run keeps one, for the figure


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


def run(experiment: Tanks, n: int, learner: str, seed: int) -> Run:
    """Learn, cross-validate what may be chosen, and return the scores."""
    warnings.simplefilter("ignore", SamplingWarning)
    settings = experiment.settings
    by = CHOSEN["overflow" if learner.startswith("overflow") else ""]
    known = _fitted(by, settings) if learner in GPS else None
    actions, lower = measured("Est", settings.samples)
    begin = time.perf_counter()
    if learner in NARX:
        made = _narx(_lags(learner), actions, lower, n, seed)
        found = _scores_of_narx(made, settings)
    elif known is not None:
        found = {"by": by, **_scores_of_gp(learner, by, known, n, seed, settings)}
    else:
        name = by if learner == TENTH else learner
        if learner == TENTH:
            rows = torch.arange(len(lower))
            lower = lower.where((rows % 10 == seed % 10) & (rows < 10 * n), torch.nan)
        fitted = fit(name, actions, lower, settings)
        found = {"by": name, **_of_fit(fitted), **_scores_of_fit(fitted, settings)}
    found["seconds"] = time.perf_counter() - begin
    if learner not in CANDIDATES:
        del found["path"]  # of which there is no figure
    if learner in CANDIDATES or (learner in NARX and seed == 0):
        errors = cross_validated(learner, n, settings)
        found |= {"cv": math.sqrt(sum(e**2 for e in errors) / len(errors)), "blocks": errors}
    return found


@cache
def _fitted(candidate: str, settings: TanksSettings) -> Fitted:
    """A candidate by all samples, as its own run has it."""
    return fit(candidate, *measured("Est", settings.samples), settings)


def fit(candidate: str, actions: Tensor, lower: Tensor, settings: TanksSettings) -> Fitted:
    """The parameters of f_p, and where the upper tank began, by all that was measured."""
    structure, _, scatter = candidate.partition("-")
    given: dict[str, Any] = {}
    if PROCESS_NOISE[scatter] is not None:
        given = {"process_noise": PROCESS_NOISE[scatter], "noise": (torch.nan, settings.noise)}
        given = {k: torch.tensor(sd, dtype=torch.float64) for k, sd in given.items()}
    unknown = physics(structure)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", SmoothingWarning)
        found = smooth(
            levels(actions, lower),
            unknown,
            start=START,
            num_starts=settings.starts,
            max_rounds=settings.rounds,
            **given,
        )
    mean = found.physics_parameters.mean.tolist()
    values = dict(zip(unknown.unknowns, mean, strict=True))
    start = Start(float(found.records.records[0].states[0, 0]), float(found.sd[0][0, 0]))
    noise, fixed = found.noise.nan_to_num(), physics(structure, values)
    return Fitted(fixed, values, start, noise, found.process_noise, not said)


def cross_validated(learner: str, n: int, settings: TanksSettings) -> list[float]:
    """Errors of blocks that were left out of the fit, root mean squares in V."""
    actions, lower = measured("Est", settings.samples)
    errors = []
    for block in blocks(settings):
        left = without(lower, block)
        if learner in NARX:
            dynamics = _narx(_lags(learner), actions, left, n, seed=0)
            state = _held(dynamics, actions, lower)
            free = dynamics.free_run(state, actions[None, :-1, None], noise=False)
            path = _from_start(free.mean, lower, free.spec)
        else:
            fitted = fit(learner, actions, left, settings)
            path = follow(fitted.physics, fitted.start, actions, lower)
        errors.append(_error(path, lower, block))
    return errors


def _lags(learner: str) -> int:
    return int(learner.rpartition("-")[2])


def _narx(lags: int, actions: Tensor, lower: Tensor, n: int, seed: int) -> LearnedDynamics:
    """A GP without f_p, of what the sensor says."""
    records = outputs(actions, lower, lags)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Left out", UserWarning)
        data = records.trajectories()
    dynamics = LearnedDynamics(records.spec, model=LEARNERS["gp"].make)
    dynamics.update(*data.spread(min(n, len(data.states)), seed))
    return dynamics


def blocks(settings: TanksSettings) -> list[slice]:
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
    function, path = PhysicsDynamics(SPEC, known).mean_function(), [_state(start, lower)]
    for action in actions[:-1]:
        path.append(function(path[-1][None], action.view(1, 1, 1))[0])
    return torch.cat(path)[:, 1].clamp(0.0, FULL)


def _of_fit(fitted: Fitted) -> Run:
    return {
        "values": fitted.values,
        "start": list(fitted.start),
        "noise": fitted.noise.tolist(),
        "process_noise": fitted.process_noise.tolist(),
        "settled": fitted.settled,
    }


def _scores_of_fit(fitted: Fitted, settings: TanksSettings) -> Run:
    """Scores of an f_p: its path without noise; intervals with all noise but of parameters."""
    actions, lower = measured("Val", settings.samples)
    dynamics = PhysicsDynamics(SPEC, fitted.physics)
    noise = {"noise": fitted.noise, "process_noise": fitted.process_noise}
    free = _with_start(dynamics, fitted.start, actions, lower, settings, **noise)
    return _scores(follow(fitted.physics, fitted.start, actions, lower), free, lower)


@cache
def smoothed(candidate: str, settings: TanksSettings) -> Any:
    """The states along the estimation record by a fitted f_p, both noises learnt.

    A fit with little process noise follows f_p so closely that there is nothing to learn about it.
    """
    records, known = levels(*measured("Est", settings.samples)), _fitted(candidate, settings)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SmoothingWarning)
        return smooth(records, known.physics, start=START)


def _scores_of_gp(
    learner: str, by: str, known: Fitted, n: int, seed: int, settings: TanksSettings
) -> Run:
    """Scores of a GP beside an f_p whose parameters are those of a candidate."""
    found = smoothed(by, settings)
    model = LEARNERS["phymean" if learner.endswith("delta") else "cka"].make
    dynamics = LearnedDynamics(SPEC, known.physics, model=model)
    data = found.draw(seed).trajectories()
    dynamics.update(*data.spread(min(n, len(data.states)), seed))
    actions, lower = measured("Val", settings.samples)
    noise = {"noise": found.noise.nan_to_num(), "process_noise": "learnt"}
    free = _with_start(dynamics, known.start, actions, lower, settings, **noise)
    return _scores(_from_start(free.mean, lower, free.spec), free, lower)


def _scores_of_narx(dynamics: LearnedDynamics, settings: TanksSettings) -> Run:
    actions, lower = measured("Val", settings.samples)
    free = dynamics.free_run(
        _held(dynamics, actions, lower),
        actions[None, :-1, None],
        num_functions=settings.num_functions,
        start_noise="learnt",
    )
    return _scores(_from_start(free.mean, lower, free.spec), free, lower)


def _with_start(
    dynamics: Dynamics, start: Start, actions: Tensor, lower: Tensor, settings: TanksSettings,
    *, noise: Tensor, process_noise: Any,
) -> FreeRun:  # fmt: skip
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


def _scores(path: Tensor, free: FreeRun, lower: Tensor) -> Run:
    """Error in V and coverage after the first sample, and some of the path for the figure."""
    low, high = (_from_start(end, lower, free.spec) for end in (free.lower, free.upper))
    inside = (lower >= low - 1e-9) & (lower <= high + 1e-9)
    kept = {"mean": path, "lower": low, "upper": high}
    return {
        "rmse": _error(path, lower, slice(1, None)),
        "coverage": float(inside[1:].double().mean()),
        "width": float((high - low)[1:].mean()),
        "lost": float(free.lost[0, -1]),
        "path": {name: [round(v, 3) for v in x[::_KEPT].tolist()] for name, x in kept.items()},
    }


def load(runs: Sequence[Run]) -> pd.DataFrame:
    """A row for each run, without parameters and paths."""
    shown = ("learner", "n", "seed", "by", "cv", "rmse", "coverage", "width", "seconds", "settled")
    return pd.DataFrame([{name: each.get(name) for name in shown} for each in runs])


def chosen(runs: pd.DataFrame, among: Iterable[str]) -> str:
    """The learner with the least cross-validated error."""
    names = [*among]
    own = runs[runs["learner"].isin(names)].dropna(subset="cv").set_index("learner")["cv"]
    return str(own.astype(float).idxmin()) if len(own) else names[0]


def tables(runs: Sequence[Run], experiment: Tanks) -> dict[str, Table]:
    """All tables, by name."""
    scored = load(runs)
    best = chosen(scored, CANDIDATES)
    labels: dict[str, str] = {**experiment.axes["learner"], best: f"{CANDIDATES[best]}, chosen"}
    return {
        "candidates": Table("Structures and process noise", _candidates(scored, best)),
        "learners": Table("Free runs of the validation record", _learners(scored, best, labels)),
    }


def _candidates(runs: pd.DataFrame, best: str) -> str:
    """A row for each that was cross-validated."""
    rows, bold = {}, (best, chosen(runs, NARX))
    for learner in (*CANDIDATES, *NARX):
        own = runs[(runs["learner"] == learner) & runs["cv"].notna()]
        if len(own):
            label = {**CANDIDATES, **NARX}[learner]
            label = f"**{label}**" if learner in bold else label
            unsettled = "" if own["settled"].iloc[0] in (None, True) else " (not settled)"
            rows[f"{label}{unsettled}"] = own
    return table(
        rows,
        {
            "parameters": lambda own: _count(own["learner"].iloc[0]),
            "cross-validated, V": of("cv", form=".3f"),
            "validation, V": of("rmse", form=".3f"),
        },
    )


def _count(learner: str) -> str:
    structure = learner.partition("-")[0]
    return f"{len(UNKNOWNS.keys() - FIXED[structure].keys())}" if learner in CANDIDATES else ""


def _learners(runs: pd.DataFrame, best: str, labels: dict[str, str]) -> str:
    """A row for what was chosen, and for all that learns from fewer data or with a GP."""
    bent = chosen(runs, [name for name in CANDIDATES if name.startswith("overflow")])
    columns = {"coverage of 95 %": ("coverage", ".2f"), "width, V": ("width", ".2f")}
    columns |= {"seconds": ("seconds", ".2g")}
    rows = []
    for learner in (best, bent, TENTH, *GPS, chosen(runs, NARX)):
        for n, own in runs[runs["learner"] == learner].groupby("n", sort=True):
            errors = own["rmse"].astype(float)
            cells = [_with_error("rmse", ".3f")(own), number(errors.max(), ".3f")]
            cells += [_with_error(*column)(own) for column in columns.values()]
            rows.append([labels[learner], f"{n}", f"{len(own)}", *cells])
    published = sorted(PUBLISHED.items(), key=lambda pair: -pair[1])
    rows += [[f"{name}, published", "", "", f"{e:.3f}", "", "", "", ""] for name, e in published]
    return markdown(["", "n", "runs", "RMSE, V", "the worst", *columns], rows)


def _with_error(column: str, form: str) -> Cell:
    """The mean with its standard error."""

    def cell(own: pd.DataFrame) -> str:
        found = Difference.of(own[column].astype(float))
        if np.isnan(found.error):
            return number(found.mean, form)
        return f"{found.mean:{form}} ± {found.error:{'.1g' if form.endswith('g') else form}}"

    return cell
