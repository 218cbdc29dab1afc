"""Real episodes: how they complete and check a task, and how its dynamics learn them."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gpadjust.control.delay import find_delay
from gpadjust.control.rollouts import reach
from gpadjust.control.task import Task
from gpadjust.dynamics import Dynamics, LearnedDynamics, Trajectories
from gpadjust.dynamics.base import typical_change
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec
from gpadjust.validation.trust import trust

_NEAR = 0.05  # of half the width between bounds: a state that is so near may be held by them
_MOST = 10.0  # times as far they may be by what the physics reaches
_REACH = 10.0  # half ranges of the recorded states, from their middle to the bounds
_ROUNDING = 1e-5  # of set-points, in single precision
_WINDOWS = 4  # of which trajectories are scored: some half second for a model of an episode
_FAR = ("nlpd", "coverage", "energy")


def completed(task: Task, data: Trajectories, episode_length: int, action_bounds: Tensor) -> Task:
    """Return a task with length, starts and bounds of real episodes where it has none.

    The bounds are beyond what was measured and what the physics reaches within an episode from
    where these started, by actions within their bounds ``2 x action_dim``.
    """
    found: dict[str, Any] = {"episode_length": episode_length}
    starts = data.states[data.steps == 1]
    if len(data):
        found["initial_states"] = lambda n: starts[torch.randint(len(starts), (n,))]
    if len(data) and task.state_bounds is None:
        physics, length = task.dynamics.physics_alone(), task.episode_length or episode_length
        reached = None if physics is None else reach(physics, starts, action_bounds, length)
        found["state_bounds"] = far_bounds(task.dynamics.spec, data, reached)
    return replace(task, **{k: v for k, v in found.items() if getattr(task, k) is None})


def far_bounds(spec: StateSpec, data: Trajectories, reached: Tensor | None = None) -> Tensor:
    """Return bounds ``2 x state_dim`` far beyond the states of real episodes.

    They are infinite for angles, constants and previous values.

    Args:
        spec: The entries of states.
        data: The episodes.
        reached: Least and greatest states that the physics reaches. The bounds leave room for
            them and half of their range beyond, within a hundred half ranges of the data: where
            the physics runs away, it tells nothing of the system.
    """
    states = torch.cat([data.states, data.next_states])
    low, high = states.amin(0), states.amax(0)
    room = _REACH * (high - low) / 2
    room[high == low] = torch.inf  # that it has not moved yet tells nothing
    free = {*spec.angles, *spec.exogenous, *spec.previous}
    room[[i for i, name in enumerate(spec.states) if name in free]] = torch.inf
    middle = (low + high) / 2
    near = far = torch.stack([middle - room, middle + room])
    if reached is not None:
        beyond = (reached[1] - reached[0]) / 2
        far = torch.stack([reached[0] - beyond, reached[1] + beyond])
        far = torch.clamp(far, middle - _MOST * room, middle + _MOST * room)
    return torch.stack([torch.minimum(near[0], far[0]), torch.maximum(near[1], far[1])])


def warn_of_bounds(spec: StateSpec, data: Trajectories, bounds: Tensor) -> None:
    """Warn if states came to bounds ``2 x state_dim`` that nobody gave."""
    near = _NEAR * (bounds[1] - bounds[0]) / 2
    for bound, sign in zip(bounds, (-1, 1), strict=True):
        come = (sign * (bound - data.next_states) < near).any(0) & bound.isfinite()
        for i in come.nonzero().flatten().tolist():
            column = data.next_states[:, i]
            extreme = column.amax() if sign > 0 else column.amin()
            warnings.warn(
                f"An episode came to {spec.states[i]} = {float(extreme):.3g}, where the model was "
                f"not followed beyond {float(bound[i]):.3g}: a bound of what had been measured and "
                "what the physics reaches, which may have held it there. Give the task "
                "state_bounds that leave room for where it is to go.",
                UserWarning,
                stacklevel=5,
            )


def learnable(dynamics: Dynamics, data: Trajectories) -> Trajectories:
    """Return all steps but those at which the physics fails.

    Raises:
        PhysicsError: If it does not say where, or everywhere.
    """
    works = torch.ones(len(data), dtype=torch.bool)
    while True:
        try:
            dynamics.try_physics(data.states[works], data.actions[works])
        except PhysicsError as error:
            rows = works.nonzero().flatten()[list(error.rows)]
            if not len(rows) or len(rows) == works.sum():
                raise
            warnings.warn(
                f"The physics fails at {len(rows)} of {len(works)} new transitions, which the "
                f"dynamics do not learn: {error}",
                UserWarning,
                stacklevel=4,
            )
            works[rows] = False
        else:
            return data if works.all() else data.some(works)


def check_functions(task: Task, data: Trajectories, tolerance: float = 1e-3) -> None:
    """Compare the functions of a task with the rewards and terminations of real episodes.

    Args:
        task: The user's.
        data: The episodes.
        tolerance: Greatest error of the reward, relative to the largest real one.

    Raises:
        ValueError: If they differ; it shows the worst transition.
    """
    _check_reference(task, data)

    def row(i: int) -> str:
        parts = ("states", "actions", "next_states")
        return ", ".join(f"{part}[{i}] = {getattr(data, part)[i].tolist()}" for part in parts)

    rewards = task.rewards(*data).double()
    error = (rewards - data.rewards).abs()
    if (error > tolerance * data.rewards.abs().max().clamp_min(1e-6)).any():
        i = int(error.argmax())
        raise ValueError(
            "reward(states, actions, next_states) is not the environment's: transition "
            f"{i} gave {data.rewards[i]:.6g}, but the function says {rewards[i]:.6g}; "
            f"{row(i)}. Correct the function, or the spec of the state (its order, and "
            "which entries are angles, seen as sine and then cosine). If rewards or "
            "observations are noisy, raise reward_tolerance; None checks nothing."
        )
    says = task.terminations(data.next_states)
    wrong = (says != data.terminated).nonzero()
    if len(wrong):
        i = int(wrong[0])
        given = "the function says" if task.terminated is not None else "none was given, that is"
        raise ValueError(
            f"terminated(states) is not the environment's: transition {i} was recorded with "
            f"terminated={bool(data.terminated[i])}, but {given} {bool(says[i])}; "
            f"{row(i)}. Pass the termination that the environment has."
        )


def _check_reference(task: Task, data: Trajectories) -> None:
    """Compare the reference of a task with the exogenous states of real episodes."""
    spec, steps = task.dynamics.spec, data.steps
    expected = task.set_points(data.states, steps)
    if expected is None:
        return
    columns = spec.exogenous_columns
    real, after = data.next_states[:, columns], data.next_states.clone()
    after[:, columns] = expected
    apart = spec.change(after, data.next_states)[:, columns].abs()  # of angles the shortest way
    off = (apart > _ROUNDING * real.abs().clamp_min(1.0)).any(1).nonzero()
    if len(off):
        i = int(off[0])
        raise ValueError(
            f"reference(states, steps) is not the environment's: after step {int(steps[i])} of an "
            f"episode it says {expected[i].tolist()} for {tuple(spec.exogenous)}, but "
            f"{real[i].tolist()} was observed. Number the steps from 1, for the state after the "
            "first."
        )


def learn_dynamics(
    task: Task,
    new: Trajectories,
    recorded: Trajectories,
    horizons: tuple[int, ...],
) -> dict[str, float]:
    """Score the dynamics of a task on new episodes, and update them with these.

    With sensors they forget what they have learnt, and learn all episodes again, as the states
    behind all of them are estimated better by now.

    PyTorch's generator is left as it is by the scores. Scores that are not defined (densities of
    dynamics without variances, horizons longer than the episodes) are left out.

    Args:
        task: The task, with bounds of the states.
        new: Episodes that the dynamics have not learnt.
        recorded: All episodes; energy scores are in units of their typical changes, so that those
            of different episodes can be compared.
        horizons: Numbers of steps over which trajectories are scored; none for scores of single
            steps alone.

    Returns:
        ``nlpd`` and ``coverage`` of a step, ``rmse/<state>``; ``overrides``, the share of
        predictions in which data override the physics; ``nlpd_15``, ``coverage_15`` and
        ``energy_15`` of a horizon of 15; ``score_seconds``, ``fit_seconds``.
    """
    start, found = time.perf_counter(), {}
    if task.reference is not None:  # set-points stay as they are in the dynamics
        new, recorded = (_with_still_set_points(task, each) for each in (new, recorded))
    data = learnable(task.dynamics, new)
    if task.dynamics.is_fitted:
        before = time.perf_counter()
        found = _scores(task, data, recorded, horizons)
        found["score_seconds"] = time.perf_counter() - before
    if task.sensors is None:
        task.dynamics.update(*data)
    else:
        _learn_again(task.dynamics, recorded)
    _warn_of_delay(task.dynamics, recorded, len(new))
    found["fit_seconds"] = time.perf_counter() - start - found.get("score_seconds", 0.0)
    return {name: value for name, value in found.items() if not math.isnan(value)}


def _with_still_set_points(task: Task, data: Trajectories) -> Trajectories:
    """Return episodes whose exogenous states stay in a step as they were before it."""
    next_states, still = data.next_states.clone(), task.dynamics.spec.exogenous_columns
    next_states[:, still] = data.states[:, still]
    return replace(data, next_states=next_states)


def _learn_again(dynamics: Dynamics, recorded: Trajectories) -> None:
    """Let dynamics forget what they have learnt, and learn all episodes; not if this fails."""
    data, before = learnable(dynamics, recorded), dynamics.state_dict()
    dynamics.load_state_dict({})
    try:
        dynamics.update(*data)
    except BaseException:
        dynamics.load_state_dict(before)
        raise


def _warn_of_delay(dynamics: Dynamics, recorded: Trajectories, num_new: int) -> None:
    """Warn of a delay that was not told, after the episodes that have shown it first."""
    physics = dynamics.physics_alone()
    if physics is None:
        return
    found, earlier = find_delay(physics, recorded), recorded.some(slice(len(recorded) - num_new))
    if found is not None and find_delay(physics, earlier) is None:
        warnings.warn(str(found), UserWarning, stacklevel=4)


def _scores(
    task: Task, new: Trajectories, recorded: Trajectories, horizons: tuple[int, ...]
) -> dict[str, float]:
    dynamics, spec = task.dynamics, task.dynamics.spec
    score = dynamics.score(*new)
    found = {"nlpd": float(score.nlpd.mean()), "coverage": float(score.coverage.mean())}
    names = [spec.states[i] for i in spec.moving]
    found |= {f"rmse/{name}": float(e) for name, e in zip(names, score.rmse, strict=True)}
    if isinstance(dynamics, LearnedDynamics):
        model, inputs = dynamics.model, dynamics.targets.inputs(new.states, new.actions)
        if any(term.physics is not None for term in model.terms):
            found["overrides"] = float(trust(model, inputs).data.mean())
    possible = [k for k in horizons if k <= new.longest]
    if not possible:
        return found
    windows = new.windows(possible[-1], stride=1)
    last = len(windows.actions) - 1
    windows = windows.some(torch.linspace(0, last, min(last + 1, _WINDOWS)).round().long())
    try:
        run = dynamics.free_run(
            windows.initial_states,
            windows.actions,
            state_bounds=task.widened(new.states).state_bounds,
        )
    except (NotImplementedError, PhysicsError) as error:  # scores are not worth an episode
        warnings.warn(
            f"There are no scores of trajectories, as their particles cannot move: {error} Pass "
            "score_horizons=() to do without.",
            UserWarning,
            stacklevel=4,
        )
        return found
    units = typical_change(spec, recorded.states, recorded.next_states)
    far = run.score(windows.measured, horizons=possible, units=units)
    for i, horizon in enumerate(possible):
        for name in _FAR:
            values = getattr(far, name)[i]
            values = values if name == "energy" else values[spec.moving]
            found[f"{name}_{horizon}"] = float(values.mean())
    return found
