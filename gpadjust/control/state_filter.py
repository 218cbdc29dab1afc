"""States behind sensors: a filter during an episode, a smoother of all episodes after it.

Outputs and dynamics are linearised at the estimated states (Jazwinski 1970).
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

_SHARE = 0.1  # sd of noises before there are data, as a share of the change in a step
_EPISODES = 64  # episodes of random actions in the physics, for these changes
_HOLD = 5  # steps of these
_ROUNDS = 30  # largest number of rounds of the smoother
_GUESSED, _GIVEN = 1.0, 10.0  # weight of our and the user's guess of a noise, in measurements
_LONGER = 1.6  # factor of a step of expectation maximisation, in logarithms
_STEADY = 0.02  # largest change of the logarithm of a variance at the end
_TINY = 1e-300  # in place of a variance of zero


class Estimate(NamedTuple):
    """An estimate of a state, and the action there."""

    mean: Tensor  #: state_dim
    covariance: Tensor  #: state_dim x state_dim
    action: Tensor | None = None  #: action_dim


class StateFilter(NamedTuple):
    """An extended Kalman filter over the dynamics of a task.

    A step adds the predicted variance of the dynamics, or the process noise where that is zero, as
    in f_p.
    """

    start: Estimate  #: where episodes start
    noise: Tensor  #: sd of the sensors' noise, one for each output
    process_noise: Tensor  #: sd of the error of the mean of the dynamics in a step, state_dim

    @classmethod
    def guessed(cls, task: Task, action_bounds: Tensor) -> Self:
        """Return the filter before there are data, by random actions in a task's model.

        Both noises are a tenth of the change in a first step (an unstable system runs away later),
        unless the sensors have a guess. PyTorch's generator stays as it is.
        """
        spec, sensors = task.dynamics.spec, task.sensors
        assert sensors is not None, "checked before"
        length = min(task.episode_length or 1, _HOLD)
        with seeded(0), torch.no_grad():
            starts = task.draw_initial_states(_EPISODES)
            sequences = random_sequences(_EPISODES, length, action_bounds, _HOLD)
            run = Rollouts(task, None).follow(starts, sequences)
            states, following = run.states[run.made], run.next_states[run.made]
            outputs = [sensors.measure(spec, rows) for rows in (states, following)]
        change = spec.change(states, following).square().mean(0)
        noise = _SHARE * sensors.spec(spec).change(*outputs).square().mean(0).sqrt()
        for name, guess in sensors.noise.items():
            noise[sensors.outputs.index(name)] = guess
        process_noise = _SHARE * spec.complete_variance(change[spec.predicted]).sqrt()
        # The mean of angles is taken of differences to the first start.
        off = spec.change(starts[:1].expand_as(starts), starts)
        spread = torch.atleast_2d(off.mT.cov(correction=0))
        return cls(Estimate(starts[0] + off.mean(0), spread), noise.clamp_min(1e-9), process_noise)

    def follow(
        self, task: Task, observations: Tensor, earlier: Sequence[Estimate | None]
    ) -> list[Estimate]:
        """Estimate the states of ``n`` episodes after their next observations.

        Args:
            task: The task in the newest model.
            observations: Values of the sensors, ``n x observation_dim``.
            earlier: The previous estimates with actions; None in an episode that begins.
        """
        spec = task.dynamics.spec
        ahead = [estimate or self.start for estimate in earlier]
        going = [i for i, estimate in enumerate(earlier) if estimate is not None]
        if going:
            actions = torch.stack([torch.as_tensor(ahead[i].action) for i in going])
            near = linearised(task.dynamics, torch.stack([ahead[i].mean for i in going]), actions)
            added = torch.where(near.variance > 0, near.variance, self.process_noise.square())
            # P' = F P F^T + Q
            spread = torch.stack([ahead[i].covariance for i in going])
            spread = near._replace(variance=added).carry(spread)
            for i, mean, covariance in zip(going, near.mean, spread, strict=True):
                ahead[i] = Estimate(mean, covariance)
        means = torch.stack([estimate.mean for estimate in ahead])
        slopes, values = _linear_outputs(task, means, observations)
        noise = self.noise.square().numpy()
        estimates = []
        for before, slope, value in zip(ahead, slopes.numpy(), values.numpy(), strict=True):
            prior = before.mean.numpy(), before.covariance.numpy()
            mean, covariance, _ = measure(*prior, slope, value, noise)
            wrapped = spec.decode(spec.observe(torch.from_numpy(mean)))
            estimates.append(Estimate(wrapped, torch.from_numpy(covariance)))
        return estimates


def smooth_episodes(
    task: Task, state_filter: StateFilter, observed: Trajectories, seed: int
) -> tuple[StateFilter, Trajectories]:
    """Estimate the states behind episodes of observations, and both noises.

    An iterated extended Kalman smoother with expectation maximisation, as of
    :func:`~gpadjust.records.smooth`, with the mean of the task's dynamics in place of f_p. Return
    the filter with the most likely noises, and a draw of the states, as rough as the true ones.
    """
    spec, sensors, episodes = task.dynamics.spec, task.sensors, observed.episodes()
    assert sensors is not None, "checked before"
    observations = [torch.cat([part.states, part.next_states[-1:]]) for part in episodes]

    def linear_chain(paths: Sequence[Tensor]) -> tuple[list[Link], Tensor]:
        """Return the episodes near paths as a linear chain, and the mean predicted variance."""
        # x' = F x + (f(x) - F x)
        states = torch.cat([path[:-1] for path in paths])
        near = linearised(task.dynamics, states, observed.actions)
        offsets = states + spec.change(states, near.mean)
        offsets = offsets - (near.slope @ states.unsqueeze(-1)).squeeze(-1)
        steps = zip(*(part.split(lengths) for part in (near.slope, offsets)), strict=True)
        outputs = [_linear_outputs(task, *p) for p in zip(paths, observations, strict=True)]
        pairs = zip(steps, outputs, strict=True)
        links = [Link(*(part.numpy() for part in (*step, *output))) for step, output in pairs]
        return links, near.variance.mean(0)

    lengths = [len(part) for part in episodes]
    paths = _filtered(task, state_filter, episodes, observations)
    first, covariance, _ = state_filter.start
    near = [path[0] + spec.change(path[0], first) for path in paths]
    starts = [(mean.numpy(), covariance.numpy()) for mean in near]
    noise = state_filter.noise.square().numpy()
    # A guess of the user has the weight of ten measurements.
    is_given = [name in sensors.noise for name in sensors.outputs]
    guesses = [sensors.noise.get(name, 1.0) ** 2 for name in sensors.outputs]
    prior = np.where(is_given, guesses, noise)
    weight = np.where(is_given, _GIVEN, _GUESSED)
    links, predicted = linear_chain(paths)
    added = torch.where(predicted > 0, predicted, state_filter.process_noise.square()).numpy()
    for _ in range(_ROUNDS):
        # Smooth, and linearise along the smoothed paths.
        smoothed, _ = smooth_chain(links, starts, noise, added)
        links, _ = linear_chain([torch.from_numpy(chain.states.means) for chain in smoothed])
        # The variances of the next round: expected squares, and longer steps than these ask for.
        errors, steps = expected_squares(links, smoothed, spec.state_dim)
        likely = (errors.sum(0) + weight * prior) / (len(errors) + weight)
        step = torch.from_numpy(steps.mean(0))[spec.predicted]
        new = np.concatenate([likely, spec.complete_variance(step).numpy()])
        old = np.concatenate([noise, added])
        moved = np.log(new.clip(_TINY) / old.clip(_TINY), where=old > 0, out=np.zeros_like(old))
        noise, added = np.split(old * np.exp(_LONGER * moved), [len(noise)])
        if (np.abs(moved) < _STEADY).all():
            break
    estimated = state_filter._replace(
        noise=torch.from_numpy(noise).sqrt(), process_noise=torch.from_numpy(added).sqrt()
    )
    drawn = map(torch.from_numpy, draw_paths(smoothed, 0, np.random.default_rng(seed)))
    paths = [spec.decode(spec.observe(path)) for path in drawn]  # angles within half a turn
    states, following = (torch.cat([p[i : len(p) - 1 + i] for p in paths]) for i in (0, 1))
    return estimated, replace(observed, states=states, next_states=following)


def _filtered(
    task: Task,
    state_filter: StateFilter,
    episodes: Sequence[Trajectories],
    observations: Sequence[Tensor],
) -> list[Tensor]:
    """Return the filtered states of episodes, as paths whose angles do not jump."""
    paths: list[list[Tensor]] = [[] for _ in episodes]
    now: list[Estimate | None] = [None] * len(episodes)
    for t in range(max(map(len, observations))):
        going = [i for i, part in enumerate(observations) if len(part) > t]
        rows = torch.stack([observations[i][t] for i in going])
        estimates = state_filter.follow(task, rows, [now[i] for i in going])
        for i, estimate in zip(going, estimates, strict=True):
            paths[i].append(estimate.mean)
            if t < len(episodes[i]):
                now[i] = estimate._replace(action=episodes[i].actions[t])
    stacked = [torch.stack(path).unsqueeze(0) for path in paths]
    return [without_jumps(task.dynamics.spec, path[:, 0], path).squeeze(0) for path in stacked]


def _linear_outputs(task: Task, states: Tensor, observations: Tensor) -> tuple[Tensor, Tensor]:
    """Return outputs as matrices ``N x m x state_dim`` times states, and their values ``N x m``."""
    spec, sensors = task.dynamics.spec, task.sensors
    assert sensors is not None, "checked before"
    with torch.enable_grad():
        at = states.detach().clone().requires_grad_(True)
        values = sensors.measure(spec, at)
        (slope,) = derivatives(values, [at])
    # y - h(x) + H x, of angles the short way
    outputs = sensors.spec(spec)
    off = outputs.change(values.detach(), outputs.decode(observations))
    return slope, off + (slope @ states.unsqueeze(-1)).squeeze(-1)
