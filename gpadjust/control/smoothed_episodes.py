"""The states behind real episodes that were seen through sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gpadjust.control.state_filter import Estimate, StateFilter, measured_near, wrapped
from gpadjust.control.task import Task
from gpadjust.dynamics import Trajectories
from gpadjust.dynamics.linearised import linearised
from gpadjust.records.kalman import (
    Array,
    Link,
    draw_paths,
    expected_squares,
    smooth_chain,
)
from gpadjust.states import StateSpec

_ROUNDS = 30
_GUESSED = 1.0  # measurements that what was known of a noise counts for
_TOLD = 10.0  # those that the user's guess counts for
_LONGER = 1.6  # than a step of expectation maximisation, in logarithms
_STEADY = 0.02  # a change of the logarithm of a variance
_TINY = 1e-300  # of a variance that is none


def smooth_episodes(
    task: Task, known: StateFilter, episodes: Sequence[Trajectories], seed: int
) -> tuple[StateFilter, list[Tensor]]:
    """Estimate the states behind episodes, and both noises.

    An iterated extended Kalman smoother, and expectation maximisation, as of
    :func:`~gpadjust.records.smooth`, with the mean of the task's dynamics in the place of f_p, and
    any outputs in that of states.

    Args:
        task: The task in the newest model.
        known: The filter by which the episodes were played.
        episodes: The episodes, with observations in the place of states.
        seed: Seed of the draw.

    Returns:
        The filter with the noises that are most likely, and of each episode states
        ``(T + 1) x state_dim``, drawn from their posterior: as rough as the machine's.
    """
    spec, paths = task.dynamics.spec, _filtered(task, known, episodes)
    first, covariance, _ = known.start
    near = [path[0] + spec.change(path[0], first) for path in paths]
    starts = [(mean.numpy(), covariance.numpy()) for mean in near]
    noise = known.noise.square().numpy()
    prior, weight = _prior(task, noise)
    links, predicted = _links(task, paths, episodes)
    added = np.where(predicted > 0, predicted, known.process_noise.square().numpy())
    for _ in range(_ROUNDS):
        found, _ = smooth_chain(links, starts, noise, added)
        links, _ = _links(task, [torch.from_numpy(each.states.means) for each in found], episodes)
        errors, steps = expected_squares(links, found, spec.state_dim)
        likely = (errors.sum(0) + weight * prior) / (len(errors) + weight)
        step = torch.from_numpy(steps.mean(0))[spec.predicted]
        new = np.concatenate([likely, spec.complete_variance(step).numpy()])
        old = np.concatenate([noise, added])
        moved = np.log(new.clip(_TINY) / old.clip(_TINY), where=old > 0, out=np.zeros_like(old))
        noise, added = np.split(old * np.exp(_LONGER * moved), [len(noise)])
        if (np.abs(moved) < _STEADY).all():
            break
    drawn = draw_paths(found, 0, np.random.default_rng(seed))
    sd = (torch.from_numpy(variance).sqrt() for variance in (noise, added))
    learnt = StateFilter(known.start, *sd)
    return learnt, [wrapped(task, torch.from_numpy(path)) for path in drawn]


def _prior(task: Task, known: Array) -> tuple[Array, Array]:
    """Variances of the noise as they are guessed, and the measurements that these count for."""
    sensors = task.sensors
    assert sensors is not None, "asked before"
    told = [name in sensors.noise for name in sensors.outputs]
    guesses = [sensors.noise.get(name, 1.0) ** 2 for name in sensors.outputs]
    return np.where(told, guesses, known), np.where(told, _TOLD, _GUESSED)


def _filtered(task: Task, known: StateFilter, episodes: Sequence[Trajectories]) -> list[Tensor]:
    """Where the filter believes the episodes to be, each time by what it has seen until then."""
    paths = [list[Tensor]() for _ in episodes]
    now: list[Estimate | None] = [None] * len(episodes)
    seen = [_observations(each) for each in episodes]
    for t in range(max(map(len, seen))):
        going = [i for i, each in enumerate(seen) if len(each) > t]
        rows = torch.stack([seen[i][t] for i in going])
        found = known.follow(task, rows, [now[i] for i in going])
        for i, estimate in zip(going, found, strict=True):
            paths[i].append(estimate.mean)
            if t < len(episodes[i].actions):
                now[i] = estimate._replace(action=episodes[i].actions[t])
    return [_without_jumps(task.dynamics.spec, torch.stack(path)) for path in paths]


def _observations(episode: Trajectories) -> Tensor:
    """Return all observations of an episode of ``T`` steps, ``(T + 1) x observation_dim``."""
    return torch.cat([episode.states, episode.next_states[-1:]])


def _without_jumps(spec: StateSpec, path: Tensor) -> Tensor:
    """A path whose angles go on beyond half a turn."""
    return path[0] + torch.cat(
        [torch.zeros_like(path[:1]), spec.change(path[:-1], path[1:])]
    ).cumsum(0)


def _links(
    task: Task, paths: Sequence[Tensor], episodes: Sequence[Trajectories]
) -> tuple[list[Link], Array]:
    """The episodes near paths as a linear chain, and the mean variance that is predicted there."""
    spec = task.dynamics.spec
    states = torch.cat([path[:-1] for path in paths])
    near = linearised(task.dynamics, states, torch.cat([each.actions for each in episodes]))
    following = states + spec.change(states, near.mean)
    offsets = following - (near.slope @ states.unsqueeze(-1)).squeeze(-1)
    lengths = [len(each.actions) for each in episodes]
    parts = zip(paths, episodes, near.slope.split(lengths), offsets.split(lengths), strict=True)
    links = []
    for path, seen, slope, offset in parts:
        pair = measured_near(task, path, _observations(seen))
        links.append(Link(*(part.numpy() for part in (slope, offset, *pair))))
    variance: Array = near.variance.mean(0).numpy()
    return links, variance
