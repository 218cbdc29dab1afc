"""Real episodes: how they complete and check a task, and how its dynamics learn them."""

from __future__ import annotations

import math
import random
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpadjust.control.delay import find_delay
from gpadjust.control.rollouts import reach
from gpadjust.control.task import Task
from gpadjust.display import html_table
from gpadjust.dynamics import Dynamics, LearnedDynamics, Trajectories
from gpadjust.dynamics.base import typical_change
from gpadjust.physics import PhysicsError
from gpadjust.states import StateSpec
from gpadjust.validation.trust import trust
from gpadjust.words import number

_NEAR = 0.05  # of half the width between bounds: a state that is so near may be held by them
_MOST = 10.0  # times as far they may be by what the physics reaches
_REACH = 10.0  # half ranges of the recorded states, from their middle to the bounds
_ROUNDING = 1e-5  # of set-points, in single precision
_WINDOWS = 4  # of which trajectories are scored: some half second for a model of an episode

Row = tuple[Any, ...]
"""A real step: observation, action, next observation, reward, and whether it terminated."""


def recorded(rows: Sequence[Row]) -> Trajectories:
    """Return the steps of an episode, with observations in the place of states."""
    columns = [np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)]
    before, actions, after, rewards, terminated = map(torch.from_numpy, columns)
    return Trajectories(before, actions, after, torch.zeros(len(rows)), rewards, terminated.bool())


def nothing(width: int, action_dim: int) -> Trajectories:
    """Return no steps, of states or observations of some width."""
    states, actions = (torch.empty(0, size, dtype=torch.float64) for size in (width, action_dim))
    none = torch.empty(0, dtype=torch.float64)
    return Trajectories(states, actions, states, none, none, none.bool())


def decoded(spec: StateSpec, data: Trajectories) -> Trajectories:
    """Return trajectories of states, of some of observations."""
    states, next_states = spec.decode(data.states), spec.decode(data.next_states)
    return replace(data, states=states, next_states=next_states)


def newest(data: Trajectories, steps: int | None) -> Trajectories:
    """Return the newest steps; None for all."""
    return data if steps is None else data.subset(slice(max(len(data) - steps, 0), None))


def action_bounds(env: Any) -> Tensor:
    """Return lower and upper bounds of the actions, ``2 x action_dim``."""
    space = env.action_space
    return torch.from_numpy(np.stack([space.low, space.high]).astype(np.float64))


def episode_length(task: Task, env: Any) -> int:
    """Return the steps of an episode: of the task, or else the time limit of the environment."""
    length = task.episode_length
    for name in ("spec", "_max_episode_steps"):  # the latter of a TimeLimit put around by hand
        if length is None:
            with suppress(AttributeError):
                is_vector = hasattr(env, "num_envs")
                limit = env.get_attr(name)[0] if is_vector else env.get_wrapper_attr(name)
                length = getattr(limit, "max_episode_steps", limit)
    if length is None:
        raise ValueError("The environment has no time limit; give the task an episode_length.")
    return int(length)


def layer_names(env: Any) -> list[str]:
    """Return the classes of an environment and of what it wraps, from the outside."""
    held = getattr(env, "envs", None)  # of a vectorised environment, which are alike
    first = held[0] if isinstance(held, list) and held else None
    inner = getattr(env, "venv", None) or getattr(env, "env", None) or first
    return [type(env).__name__, *([] if inner is None else layer_names(inner))]


def described(agent: Any) -> str:
    """Name an agent, its environment and dynamics, what it has done, and its last reward."""
    env = "no environment" if agent.env is None else layer_names(agent.env)[-1]
    if agent.task is None:
        return f"{type(agent).__name__}({env}, no task)"
    data, last = agent.recorded_episodes(), ""
    if len(data):
        reward = data.rewards[data.episode == data.episode[-1]].mean()
        last = f", last reward {reward:.3g} a step"
    return (
        f"{type(agent).__name__}({env}, {type(agent.task.dynamics).__name__}, "
        f"{agent.num_episodes} episodes learnt, {agent.num_timesteps} steps{last})"
    )


class EpisodeReward(NamedTuple):
    """Rewards of a real episode: its steps, and the mean of a step, also as it was promised."""

    steps: int
    reward: float
    promised: float  # NaN of none


def rewards_of(agent: Any) -> list[EpisodeReward]:
    """Return the rewards of each real episode of an agent that was recorded."""
    data = agent.recorded_episodes()
    numbers = data.episode.unique_consecutive()
    rewards = [data.rewards[data.episode == number] for number in numbers]
    promises = getattr(agent, "promises", None) or [None] * len(rewards)  # learners make none
    return [
        EpisodeReward(len(each), float(each.mean()), math.nan if promise is None else promise)
        for each, promise in zip(rewards, promises, strict=False)
    ]


def html_of(agent: Any) -> str:
    """Return a table of the first, the best and the last episode of an agent."""
    rows = rewards_of(agent)
    best = max(range(len(rows)), key=lambda i: rows[i].reward, default=0)
    named = {"first": 0, "best": best, "last": len(rows) - 1} if rows else {}
    head = ["", "episode", "steps", "reward of a step", "promised"]
    cells = [
        [name, str(i + 1), str(rows[i].steps), number(rows[i].reward), number(rows[i].promised)]
        for name, i in named.items()
    ]
    return html_table(repr(agent), head, cells)


@contextmanager
def timed(wall_time: dict[str, float], part: str) -> Iterator[None]:
    """Add the seconds of what is done inside to a part."""
    start = time.perf_counter()
    try:
        yield
    finally:
        wall_time[part] += time.perf_counter() - start


def generators() -> tuple[Any, ...]:
    """Return the state of the global generators of Python, NumPy, PyTorch and its devices."""
    devices = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return random.getstate(), np.random.get_state(), torch.get_rng_state(), devices  # noqa: NPY002


def set_generators(state: tuple[Any, ...]) -> None:
    """Set the global generators to a state."""
    random.setstate(state[0])
    np.random.set_state(state[1])  # noqa: NPY002
    torch.set_rng_state(state[2])
    if state[3] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state[3])


def try_task(task: Task, observations: np.ndarray, env: Any) -> None:
    """Call the task's functions at observations ``N x observation_dim`` and a middle action."""
    episode_length(task, env)
    observed = torch.from_numpy(observations.astype(np.float64))
    task.observed.check_observations(observed)
    before = generators()
    if task.sensors is None:  # twice, as of a single state much would look right that is not
        states = task.dynamics.spec.decode(observed).repeat(2, 1)
    else:
        states = task.draw_initial_states(2)
    task.try_functions(states, action_bounds(env).mean(0).expand(len(states), -1))
    set_generators(before)


def completed(task: Task, data: Trajectories, env: Any) -> Task:
    """Return a task with length, starts and bounds of environment and episodes where it has none.

    The bounds are beyond what was measured and what the physics reaches within an episode.
    """
    length = episode_length(task, env)
    parts: dict[str, Any] = {"episode_length": length}
    if len(data):
        starts = data.states[data.steps == 1]
        draw = lambda n: starts[torch.randint(len(starts), (n,))]  # noqa: E731
        parts["initial_states"] = task.initial_states or draw
        if task.state_bounds is None:
            physics = task.dynamics.physics_alone()
            how = starts, action_bounds(env), length
            reached = None if physics is None else reach(physics, *how)
            parts["state_bounds"] = far_bounds(task.dynamics.spec, data, reached)
    return replace(task, **parts)


def far_bounds(spec: StateSpec, data: Trajectories, reached: Tensor | None = None) -> Tensor:
    """Return bounds ``2 x state_dim`` far beyond the states of real episodes.

    They are infinite for angles, constants and previous values. They leave room for the least and
    greatest states that the physics reached, ``2 x state_dim``, and half of their range beyond,
    within a hundred half ranges of the data: where the physics runs away, it tells nothing.
    """
    states = torch.cat([data.states, data.next_states])
    low, high = states.amin(0), states.amax(0)
    middle, room = (low + high) / 2, _REACH * (high - low) / 2
    room[high == low] = torch.inf  # that it has not moved yet tells nothing
    free = {*spec.angles, *spec.exogenous, *spec.previous}
    room[[i for i, name in enumerate(spec.states) if name in free]] = torch.inf
    low, high = middle - room, middle + room
    if reached is not None:
        beyond = (reached[1] - reached[0]) / 2
        low = torch.minimum(low, (reached[0] - beyond).maximum(middle - _MOST * room))
        high = torch.maximum(high, (reached[1] + beyond).minimum(middle + _MOST * room))
    return torch.stack([low, high])


def warn_of_bounds(spec: StateSpec, data: Trajectories, bounds: Tensor) -> None:
    """Warn if states came to bounds ``2 x state_dim`` that nobody gave."""
    near = _NEAR * (bounds[1] - bounds[0]) / 2
    extremes = torch.stack([data.next_states.amin(0), data.next_states.amax(0)])
    room = torch.stack([extremes[0] - bounds[0], bounds[1] - extremes[1]])
    for side, i in ((room < near) & bounds.isfinite()).nonzero().tolist():
        warnings.warn(
            f"An episode came to {spec.states[i]} = {float(extremes[side, i]):.3g}, where the "
            f"model was not followed beyond {float(bounds[side, i]):.3g}: a bound of what had been "
            "measured and what the physics reaches, which may have held it there. Give the task "
            "state_bounds that leave room for where it is to go.",
            UserWarning,
            stacklevel=4,
        )


def warn_of_promise(values: dict[str, float], rewards: Tensor) -> None:
    """Warn if a real step gave less than promised by a quarter of the range of all rewards."""
    real, promised = values["real_reward"], values["promised_reward"]
    if promised - real <= (max(float(rewards.max()), promised) - float(rewards.min())) / 4:
        return
    warnings.warn(
        f"A step of the last real episode gave a reward of {real:.3g} on average, where "
        f"the model promised {promised:.3g}: do not trust what is done in it yet. "
        "More episodes, a careful objective (Return(quantile=0.2), with num_functions=16), or "
        "a better physics may help: gpadjust.validation.trust tells where data override it.",
        UserWarning,
        stacklevel=4,
    )


def check_functions(task: Task, data: Trajectories, tolerance: float = 1e-3) -> None:
    """Raise a ValueError with the worst transition if functions of a task are not the system's.

    The tolerance is the greatest error of a reward, relative to the largest real one.
    """
    spec, steps = task.dynamics.spec, data.steps
    expected = task.set_points(data.states, steps)
    if expected is not None:
        columns = spec.exogenous_columns
        real, after = data.next_states[:, columns], data.next_states.clone()
        after[:, columns] = expected
        apart = spec.change(after, data.next_states)[:, columns].abs()  # of angles the shortest way
        for i in (apart > _ROUNDING * real.abs().clamp_min(1.0)).any(1).nonzero().flatten():
            raise ValueError(
                "reference(states, steps) is not the environment's: after step "
                f"{int(steps[i])} of an episode it says {expected[i].tolist()} for "
                f"{tuple(spec.exogenous)}, but {real[i].tolist()} was observed. Number the steps "
                "from 1, for the state after the first."
            )

    def row(i: int) -> str:
        parts = ("states", "actions", "next_states")
        return ", ".join(f"{part}[{i}] = {getattr(data, part)[i].tolist()}" for part in parts)

    rewards = task.rewards(*data).double()
    error = (rewards - data.rewards).abs()
    if (error > tolerance * data.rewards.abs().max().clamp_min(1e-6)).any():
        i = int(error.argmax())
        raise ValueError(
            f"reward(states, actions, next_states) is not the environment's: transition {i} gave "
            f"{data.rewards[i]:.6g}, but the function says {rewards[i]:.6g}; {row(i)}. Correct the "
            "function, or the spec (order of the states, and angles, seen as sine and then "
            "cosine). If rewards are noisy, raise reward_tolerance; None checks nothing."
        )
    terminated = task.terminations(data.next_states)
    for i in (terminated != data.terminated).nonzero().flatten().tolist():
        given = "the function says" if task.terminated is not None else "none was given, that is"
        raise ValueError(
            f"terminated(states) is not the environment's: transition {i} was recorded with "
            f"terminated={bool(data.terminated[i])}, but {given} {bool(terminated[i])}; "
            f"{row(i)}. Pass the termination that the environment has."
        )


def learnable(dynamics: Dynamics, data: Trajectories) -> Trajectories:
    """Return all steps but those at which the physics fails; an error if it fails everywhere."""
    works = torch.ones(len(data), dtype=torch.bool)
    while True:
        try:
            dynamics.try_physics(data.states[works], data.actions[works])
            return data.subset(works)
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


def still(task: Task, data: Trajectories) -> Trajectories:
    """Return episodes whose set-points stay in a step as they were, as in the dynamics."""
    following, columns = data.next_states.clone(), task.dynamics.spec.exogenous_columns
    following[:, columns] = data.states[:, columns]
    return data if task.reference is None else replace(data, next_states=following)


def teach(task: Task, data: Trajectories) -> None:
    """Let the dynamics of a task learn episodes.

    With sensors they forget what they have learnt, unless this fails, as the states behind all
    episodes are estimated better by now.
    """
    dynamics = task.dynamics
    before = None if task.sensors is None else dynamics.state_dict()
    try:
        if before is not None:
            dynamics.load_state_dict({})
        dynamics.update(*still(task, data))
    except BaseException:
        if before is not None:
            dynamics.load_state_dict(before)
        raise


def warn_of_delay(dynamics: Dynamics, known: Trajectories, num_new: int) -> None:
    """Warn of a delay that was not told, after the episodes that have shown it first."""
    physics = dynamics.physics_alone()
    delay = None if physics is None else find_delay(physics, known)
    if delay and physics and find_delay(physics, known.subset(slice(len(known) - num_new))) is None:
        warnings.warn(delay, UserWarning, stacklevel=4)


def learn_dynamics(
    task: Task, new: Trajectories, known: Trajectories, horizons: Sequence[int]
) -> dict[str, float]:
    """Score the dynamics of a task on new episodes, and let them learn these.

    PyTorch's generator is left as it is by the scores. Scores that are not defined (densities of
    dynamics without variances, horizons longer than the episodes) are left out.

    Args:
        task: The task, with bounds of the states.
        new: Episodes that the dynamics have not learnt.
        known: All episodes; energy scores are in units of their typical changes, so that those
            of different episodes can be compared.
        horizons: Numbers of steps over which trajectories are scored.

    Returns:
        ``nlpd`` and ``coverage`` of a step, ``rmse/<state>``; ``overrides``, the share of
        predictions in which data override the physics; ``nlpd_15``, ``coverage_15`` and
        ``energy_15`` of a horizon of 15; ``score_seconds``, ``fit_seconds``.
    """
    dynamics, spec, start = task.dynamics, task.dynamics.spec, time.perf_counter()
    new, known = still(task, new), still(task, known)
    data, numbers = learnable(dynamics, new), dict[str, float]()
    if dynamics.is_fitted:
        # One step ahead
        score = dynamics.score(*data)
        numbers = {"nlpd": float(score.nlpd.mean()), "coverage": float(score.coverage.mean())}
        names = [f"rmse/{spec.states[i]}" for i in spec.moving]
        numbers |= dict(zip(names, score.rmse.tolist(), strict=True))
        model = dynamics.model if isinstance(dynamics, LearnedDynamics) else None
        if model is not None and any(term.physics is not None for term in model.terms):
            inputs = dynamics.targets.inputs(data.states, data.actions)  # type: ignore[attr-defined]
            numbers["overrides"] = float(trust(model, inputs).data.mean())
        # Trajectories
        horizons = [k for k in horizons if k <= data.longest]
        if horizons:
            windows = data.windows(horizons[-1], stride=1)
            last = len(windows.actions) - 1
            few = torch.linspace(0, last, min(last + 1, _WINDOWS)).round().long()
            windows, bounds = windows.subset(few), task.widened(data.states).state_bounds
            try:
                start_at = windows.initial_states, windows.actions
                run = dynamics.free_run(*start_at, state_bounds=bounds)
            except (NotImplementedError, PhysicsError) as error:  # scores are not worth an episode
                warnings.warn(
                    "There are no scores of trajectories, as their particles cannot move: "
                    f"{error} Pass score_horizons=() to do without.",
                    UserWarning,
                    stacklevel=3,
                )
            else:
                units = typical_change(spec, known.states, known.next_states)
                far = run.score(windows.measured, horizons=horizons, units=units)
                for i, k in enumerate(horizons):
                    numbers[f"nlpd_{k}"] = float(far.nlpd[i][spec.moving].mean())
                    numbers[f"coverage_{k}"] = float(far.coverage[i][spec.moving].mean())
                    numbers[f"energy_{k}"] = float(far.energy[i].mean())  # type: ignore[index]
        numbers["score_seconds"] = time.perf_counter() - start
    begun = time.perf_counter()
    warn_of_delay(dynamics, known, len(new))
    teach(task, data if task.sensors is None else learnable(dynamics, known))
    numbers["fit_seconds"] = time.perf_counter() - begun
    return {name: value for name, value in numbers.items() if not math.isnan(value)}
