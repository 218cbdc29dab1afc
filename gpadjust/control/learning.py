"""Updates of the dynamics by real episodes, after checks and scores of these."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gpadjust.checks import warn
from gpadjust.control.checkpoint import EpisodeCheckpoint
from gpadjust.control.delay import find_delay
from gpadjust.control.task import Task
from gpadjust.dynamics import Dynamics, Trajectories
from gpadjust.dynamics.base import typical_change
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec

_NEAR = 0.05  # of half the width between bounds: they may have held a state that is so near
_ROUNDING = 1e-5  # of set-points, in single precision
_WINDOWS = 4  # windows of scored trajectories: some half second for a model of an episode


@contextmanager
def locks_of(callbacks: Iterable[Any]) -> Iterator[None]:
    """Hold the locks of the checkpoints among callbacks."""
    with ExitStack() as stack:
        for callback in callbacks:
            if isinstance(callback, EpisodeCheckpoint):
                stack.enter_context(callback.locked())
        yield


def check_functions(task: Task, data: Trajectories, tolerance: float = 1e-3) -> None:
    """Raise a ValueError with the worst transition if functions of a task are not the system's.

    The tolerance is the largest error of a reward, relative to the largest real one.
    """
    spec = task.dynamics.spec
    columns = spec.exogenous_columns
    expected = task.set_points(data.states, data.steps)
    if expected is not None:
        real = data.next_states[:, columns]
        after = data.next_states.clone()
        after[:, columns] = expected
        errors = spec.change(after, data.next_states)[:, columns].abs()  # of angles the short way
        for i in (errors > _ROUNDING * real.abs().clamp_min(1.0)).any(1).nonzero().flatten():
            raise ValueError(
                "reference(states, steps) is not the environment's: after step "
                f"{int(data.steps[i])} of an episode it returns {expected[i].tolist()} for "
                f"{tuple(spec.exogenous)}, but {real[i].tolist()} was observed. Number the steps "
                "from 1, for the state after the first."
            )

    def describe_row(i: int) -> str:
        parts = ("states", "actions", "next_states")
        return ", ".join(f"{part}[{i}] = {getattr(data, part)[i].tolist()}" for part in parts)

    # |r - r'| <= tolerance max |r'|
    rewards = task.rewards(*data).double()
    error = (rewards - data.rewards).abs()
    if (error > tolerance * data.rewards.abs().max().clamp_min(1e-6)).any():
        i = int(error.argmax())
        raise ValueError(
            f"reward(states, actions, next_states) is not the environment's: transition {i} gave "
            f"{data.rewards[i]:.6g}, but the function returns {rewards[i]:.6g}; {describe_row(i)}. "
            "Correct the function, or the spec (order of the states, and angles, observed as sine "
            "and then cosine). If rewards are noisy, raise reward_tolerance; None checks nothing."
        )
    terminated = task.terminations(data.next_states)
    for i in (terminated != data.terminated).nonzero().flatten().tolist():
        raise ValueError(
            f"terminated(states) is not the environment's: transition {i} was recorded with "
            f"terminated={bool(data.terminated[i])}, but the task has {bool(terminated[i])}; "
            f"{describe_row(i)}. Pass the termination of the environment."
        )


def learnable(dynamics: Dynamics, data: Trajectories) -> Trajectories:
    """Return the steps without failures of the physics; an error if it fails everywhere."""
    works = torch.ones(len(data), dtype=torch.bool)
    while True:
        try:
            dynamics.try_physics(data.states[works], data.actions[works])
            return data.subset(works)
        except PhysicsError as error:
            rows = works.nonzero().flatten()[list(error.rows)]
            if not len(rows) or len(rows) == works.sum():
                raise
            message = f"The physics fails at {len(rows)} of {len(works)} new transitions, which"
            warn(f"{message} are left out: {error}")
            works[rows] = False


def _with_constant_set_points(task: Task, data: Trajectories) -> Trajectories:
    """Return episodes whose set-points stay the same in a step, as in the dynamics."""
    if task.reference is None:
        return data
    columns = task.dynamics.spec.exogenous_columns
    following = data.next_states.clone()
    following[:, columns] = data.states[:, columns]
    return replace(data, next_states=following)


def teach(task: Task, data: Trajectories) -> None:
    """Update the dynamics of a task by episodes; with sensors, in place of earlier ones."""
    dynamics = task.dynamics
    data = _with_constant_set_points(task, data)
    if task.sensors is None:
        dynamics.update(*data)
        return
    before = dynamics.state_dict()
    try:
        dynamics.load_state_dict({})
        dynamics.update(*data)
    except BaseException:
        dynamics.load_state_dict(before)
        raise


def warn_of_delay(dynamics: Dynamics, data: Trajectories, num_new: int) -> None:
    """Warn of a delay that the spec lacks, after the first episodes that show it."""
    physics = dynamics.physics_alone()
    if physics is None:
        return
    message = find_delay(physics, data)
    if message and find_delay(physics, data.subset(slice(len(data) - num_new))) is None:
        warn(message)


def warn_of_bounds(spec: StateSpec, data: Trajectories, bounds: Tensor) -> None:
    """Warn if states came near bounds ``2 x state_dim`` that the user did not give."""
    near = _NEAR * (bounds[1] - bounds[0]) / 2
    extremes = torch.stack([data.next_states.amin(0), data.next_states.amax(0)])
    room = torch.stack([extremes[0] - bounds[0], bounds[1] - extremes[1]])
    for side, i in ((room < near) & bounds.isfinite()).nonzero().tolist():
        message = (
            f"An episode came to {spec.states[i]} = {float(extremes[side, i]):.3g}, and the model "
            f"was not followed beyond {float(bounds[side, i]):.3g}: a default bound, which may "
            "have held it there. Give the task state_bounds with room for its goal."
        )
        warn(message)


def warn_of_promise(values: dict[str, float], rewards: Tensor) -> None:
    """Warn if a real step gave less than promised by a quarter of the range of all rewards."""
    real = values["real_reward"]  # of a step
    promised = values["promised_reward"]
    if promised - real <= (max(float(rewards.max()), promised) - float(rewards.min())) / 4:
        return
    message = (
        f"A step of the last real episode gave a reward of {real:.3g} on average, where the model "
        f"promised {promised:.3g}: do not trust it yet. More episodes, a careful objective "
        "(Return(quantile=0.2), with num_functions=16) or a better physics may help: "
        "gpadjust.validation.trust shows where data override it."
    )
    warn(message)


def learn_dynamics(
    task: Task, new: Trajectories, data: Trajectories, horizons: Sequence[int]
) -> dict[str, float]:
    """Score the dynamics of a task on new episodes, and update them by these.

    Return ``nlpd`` and ``coverage`` of a step, ``rmse/<state>``; ``nlpd_15``, ``coverage_15`` and
    ``energy_15`` of a horizon of 15, in units of the typical changes in all ``data``;
    ``score_seconds`` and ``fit_seconds``. PyTorch's generator stays as it is.
    """
    dynamics = task.dynamics
    start = time.perf_counter()
    new, data = (_with_constant_set_points(task, episodes) for episodes in (new, data))
    rows = learnable(dynamics, new)
    numbers: dict[str, float] = {}
    if dynamics.is_fitted:
        numbers = _score(task, rows, data, horizons)
        numbers["score_seconds"] = time.perf_counter() - start
    start = time.perf_counter()
    warn_of_delay(dynamics, data, len(new))
    if task.sensors is not None:
        rows = learnable(dynamics, data)
    teach(task, rows)
    numbers["fit_seconds"] = time.perf_counter() - start
    return {name: value for name, value in numbers.items() if not math.isnan(value)}


def _score(
    task: Task, new: Trajectories, data: Trajectories, horizons: Sequence[int]
) -> dict[str, float]:
    """Return scores of new episodes, one step and so many steps ahead."""
    dynamics, spec = task.dynamics, task.dynamics.spec
    score = dynamics.score(*new)
    numbers = {"nlpd": float(score.nlpd.mean()), "coverage": float(score.coverage.mean())}
    names = [f"rmse/{spec.states[i]}" for i in spec.moving]
    numbers |= dict(zip(names, score.rmse.tolist(), strict=True))
    # Open loop, from a few states
    horizons = [k for k in horizons if k <= new.longest]
    if not horizons:
        return numbers
    windows = new.windows(horizons[-1], stride=1)
    last = len(windows.actions) - 1
    windows = windows.subset(torch.linspace(0, last, min(last + 1, _WINDOWS)).round().long())
    bounds = task.widened(new.states).state_bounds
    try:
        run = dynamics.free_run(windows.initial_states, windows.actions, state_bounds=bounds)
    except (NotImplementedError, PhysicsError) as error:  # scores are not worth an episode
        message = f"Trajectories have no scores: {error} Pass score_horizons=() to do without."
        warn(message)
        return numbers
    units = typical_change(spec, data.states, data.next_states)
    scores = run.score(windows.measured, horizons=horizons, units=units)
    for i, k in enumerate(horizons):
        numbers[f"nlpd_{k}"] = float(scores.nlpd[i][spec.moving].mean())
        numbers[f"coverage_{k}"] = float(scores.coverage[i][spec.moving].mean())
        numbers[f"energy_{k}"] = float(scores.energy[i].mean())  # type: ignore[index]
    return numbers
