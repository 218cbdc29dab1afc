"""States behind what sensors show: a filter during an episode, a smoother of all episodes after it.

Outputs and dynamics are linearised where the states are believed to be (Jazwinski 1970).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from gpadjust.checks import seeded
from gpadjust.control.rollouts import Rollouts, random_sequences
from gpadjust.control.task import Task
from gpadjust.dynamics import Trajectories
from gpadjust.dynamics.base import without_jumps
from gpadjust.dynamics.linearised import derivatives, linearised
from gpadjust.records.kalman import Link, draw_paths, expected_squares, measure, smooth_chain

_SHARE = 0.1  # of what changes in a step: sd of noises, as long as nothing is known of them
_EPISODES = 64  # of random actions in the physics, by which changes are known
_HOLD = 5  # steps of these
_ROUNDS = 30  # of the smoother, at most
_GUESSED, _TOLD = 1.0, 10.0  # measurements that our guess and the user's of a noise count for
_LONGER = 1.6  # than a step of expectation maximisation, in logarithms
_STEADY = 0.02  # a change of the logarithm of a variance
_TINY = 1e-300  # in the place of a variance of zero


class Estimate(NamedTuple):
    """An estimate of a state, and the action that is taken there."""

    mean: Tensor  # state_dim
    covariance: Tensor  # state_dim x state_dim
    action: Tensor | None = None  # action_dim


class StateFilter(NamedTuple):
    """An extended Kalman filter over the dynamics of a task.

    A step adds the variance that the dynamics predict; where they state none, as f_p does not,
    ``process_noise``.

    Args:
        start: Where episodes start.
        noise: Standard deviations of the sensors' noise, one for each output.
        process_noise: Standard deviations of what a step adds to the mean of the dynamics,
            ``state_dim``.
    """

    start: Estimate
    noise: Tensor
    process_noise: Tensor

    @classmethod
    def guessed(cls, task: Task, action_bounds: Tensor) -> Self:
        """Return the filter before there are data, by random actions in a task's model.

        Both noises are a tenth of what changes in a first step there (later an unstable system runs
        away), unless the sensors have a guess. PyTorch's generator is left as it is.
        """
        spec, sensors = task.dynamics.spec, task.sensors
        assert sensors is not None, "asked before"
        length = min(task.episode_length or 1, _HOLD)
        with seeded(0), torch.no_grad():
            starts = task.draw_initial_states(_EPISODES)
            sequences = random_sequences(_EPISODES, length, action_bounds, _HOLD)
            run = Rollouts(task, None).follow(starts, sequences)
            rows, following = run.states[run.made], run.next_states[run.made]
            seen = [sensors.measure(spec, states) for states in (rows, following)]
        change = spec.change(rows, following).square().mean(0)
        noise = _SHARE * sensors.spec(spec).change(*seen).square().mean(0).sqrt()
        for name, guess in sensors.noise.items():
            noise[sensors.outputs.index(name)] = guess
        process_noise = _SHARE * spec.complete_variance(change[spec.predicted]).sqrt()
        off = spec.change(starts[:1].expand_as(starts), starts)
        spread = torch.atleast_2d(off.mT.cov(correction=0))
        return cls(Estimate(starts[0] + off.mean(0), spread), noise.clamp_min(1e-9), process_noise)

    def follow(
        self, task: Task, observations: Tensor, earlier: Sequence[Estimate | None]
    ) -> list[Estimate]:
        """Estimate the states of ``n`` episodes after their next observations.

        Args:
            task: The task in the newest model.
            observations: What the sensors show, ``n x observation_dim``.
            earlier: The estimates before, with the actions taken; None of an episode that begins.
        """
        spec = task.dynamics.spec
        ahead = [self.start if each is None else each for each in earlier]
        going = [i for i, each in enumerate(earlier) if each is not None]
        if going:
            actions = torch.stack([torch.as_tensor(ahead[i].action) for i in going])
            near = linearised(task.dynamics, torch.stack([ahead[i].mean for i in going]), actions)
            added = torch.where(near.variance > 0, near.variance, self.process_noise.square())
            spread = torch.stack([ahead[i].covariance for i in going])
            spread = near._replace(variance=added).carry(spread)
            for i, mean, covariance in zip(going, near.mean, spread, strict=True):
                ahead[i] = Estimate(mean, covariance)
        slopes, values = _measured_near(task, torch.stack([a.mean for a in ahead]), observations)
        noise, estimates = self.noise.square().numpy(), []
        for before, slope, value in zip(ahead, slopes.numpy(), values.numpy(), strict=True):
            prior = before.mean.numpy(), before.covariance.numpy()
            mean, covariance, _ = measure(*prior, slope, value, noise)
            wrapped = spec.decode(spec.observe(torch.from_numpy(mean)))
            estimates.append(Estimate(wrapped, torch.from_numpy(covariance)))
        return estimates


def smooth_episodes(
    task: Task, known: StateFilter, observed: Trajectories, seed: int
) -> tuple[StateFilter, Trajectories]:
    """Estimate the states behind episodes, and both noises.

    An iterated extended Kalman smoother, and expectation maximisation, as of
    :func:`~gpadjust.records.smooth`, with the mean of the task's dynamics in the place of f_p, and
    any outputs in the place of states.

    Args:
        task: The task in the newest model.
        known: The filter by which the episodes were played.
        observed: The episodes, with observations in the place of states.
        seed: Seed of the draw.

    Returns:
        The filter with the most likely noises, and the episodes with states drawn from their
        posterior: as rough as the machine's.
    """
    spec, sensors, episodes = task.dynamics.spec, task.sensors, observed.episodes()
    assert sensors is not None, "asked before"
    seen = [torch.cat([each.states, each.next_states[-1:]]) for each in episodes]

    def chain(paths: Sequence[Tensor]) -> tuple[list[Link], Tensor]:
        """Return the episodes near paths as a linear chain, and the mean predicted variance."""
        states = torch.cat([path[:-1] for path in paths])
        near = linearised(task.dynamics, states, observed.actions)
        offsets = states + spec.change(states, near.mean)
        offsets = offsets - (near.slope @ states.unsqueeze(-1)).squeeze(-1)
        steps = zip(*(part.split(lengths) for part in (near.slope, offsets)), strict=True)
        outputs = [_measured_near(task, *each) for each in zip(paths, seen, strict=True)]
        pairs = zip(steps, outputs, strict=True)
        links = [Link(*(part.numpy() for part in (*step, *output))) for step, output in pairs]
        return links, near.variance.mean(0)

    lengths = [len(each) for each in episodes]
    paths = _filtered(task, known, episodes, seen)
    first, covariance, _ = known.start
    near = [path[0] + spec.change(path[0], first) for path in paths]
    starts = [(mean.numpy(), covariance.numpy()) for mean in near]
    noise = known.noise.square().numpy()
    is_told = [name in sensors.noise for name in sensors.outputs]
    told = [sensors.noise.get(name, 1.0) ** 2 for name in sensors.outputs]
    prior, weight = np.where(is_told, told, noise), np.where(is_told, _TOLD, _GUESSED)
    links, predicted = chain(paths)
    added = torch.where(predicted > 0, predicted, known.process_noise.square()).numpy()
    for _ in range(_ROUNDS):
        smoothed, _ = smooth_chain(links, starts, noise, added)
        links, _ = chain([torch.from_numpy(each.states.means) for each in smoothed])
        errors, steps = expected_squares(links, smoothed, spec.state_dim)
        likely = (errors.sum(0) + weight * prior) / (len(errors) + weight)
        step = torch.from_numpy(steps.mean(0))[spec.predicted]
        new = np.concatenate([likely, spec.complete_variance(step).numpy()])
        old = np.concatenate([noise, added])
        moved = np.log(new.clip(_TINY) / old.clip(_TINY), where=old > 0, out=np.zeros_like(old))
        noise, added = np.split(old * np.exp(_LONGER * moved), [len(noise)])
        if (np.abs(moved) < _STEADY).all():
            break
    learnt = known._replace(
        noise=torch.from_numpy(noise).sqrt(), process_noise=torch.from_numpy(added).sqrt()
    )
    drawn = map(torch.from_numpy, draw_paths(smoothed, 0, np.random.default_rng(seed)))
    paths = [spec.decode(spec.observe(path)) for path in drawn]  # angles within half a turn
    states, following = (torch.cat([p[i : len(p) - 1 + i] for p in paths]) for i in (0, 1))
    return learnt, replace(observed, states=states, next_states=following)


def _filtered(
    task: Task, known: StateFilter, episodes: Sequence[Trajectories], seen: Sequence[Tensor]
) -> list[Tensor]:
    """Return where the filter believes episodes to be, by what it has seen until then."""
    paths: list[list[Tensor]] = [[] for _ in episodes]
    now: list[Estimate | None] = [None] * len(episodes)
    for t in range(max(map(len, seen))):
        going = [i for i, each in enumerate(seen) if len(each) > t]
        rows = torch.stack([seen[i][t] for i in going])
        estimates = known.follow(task, rows, [now[i] for i in going])
        for i, estimate in zip(going, estimates, strict=True):
            paths[i].append(estimate.mean)
            if t < len(episodes[i]):
                now[i] = estimate._replace(action=episodes[i].actions[t])
    whole = [torch.stack(path).unsqueeze(0) for path in paths]
    return [without_jumps(task.dynamics.spec, path[:, 0], path).squeeze(0) for path in whole]


def _measured_near(task: Task, states: Tensor, observations: Tensor) -> tuple[Tensor, Tensor]:
    """Return outputs near ``N`` states as matrices ``N x m x state_dim`` times the state.

    And what was measured as it would be by these, ``N x m``; angles the shortest way.
    """
    spec, sensors = task.dynamics.spec, task.sensors
    assert sensors is not None, "asked before"
    with torch.enable_grad():
        at = states.detach().clone().requires_grad_(True)
        values = sensors.measure(spec, at)
        (slope,) = derivatives(values, [at])
    seen = sensors.spec(spec)
    off = seen.change(values.detach(), seen.decode(observations))
    return slope, off + (slope @ states.unsqueeze(-1)).squeeze(-1)
