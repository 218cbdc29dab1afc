"""The state of an episode under way, by what sensors have shown of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from gpadjust.checks import seeded
from gpadjust.control.rollouts import Rollouts, random_sequences
from gpadjust.control.task import Task
from gpadjust.dynamics.linearised import derivatives, linearised
from gpadjust.records.kalman import Array, measure

_SHARE = 0.1  # of what changes in a step: sd of noises, as long as nothing is known of them
_EPISODES = 64  # of random actions in the physics, by which changes are known
_HOLD = 5  # steps of these


class Estimate(NamedTuple):
    """A state as it is known.

    Args:
        mean: ``state_dim``.
        covariance: ``state_dim x state_dim``.
        action: What is done there, ``action_dim``.
    """

    mean: Tensor
    covariance: Tensor
    action: Tensor | None = None


class StateFilter(NamedTuple):
    """An extended Kalman filter over the dynamics of a task (Jazwinski 1970).

    A step adds the variance that the dynamics predict; where they state none, as f_p does not,
    ``process_noise``. Outputs and dynamics are linearised where the state is believed to be.

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
        """The filter before there are data, by first steps of random actions in a task's model.

        Both noises are a tenth of what changes in a step there, unless the sensors say a guess.
        Later steps say little: where a system is not stable, they run away.
        PyTorch's generator is left as it is.

        Args:
            task: A task with sensors, starts and length.
            action_bounds: ``2 x action_dim``.
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
        """The states of ``n`` episodes after their next observations.

        Args:
            task: The task in the newest model.
            observations: Those of the sensors, ``n x observation_dim``.
            earlier: The estimates before, with the actions taken; None of an episode that begins.

        Raises:
            PhysicsError: If the physics fails at an estimate.
        """
        ahead = [self.start if each is None else each for each in earlier]
        going = [i for i, each in enumerate(earlier) if each is not None]
        if going:
            actions = [torch.as_tensor(ahead[i].action) for i in going]
            near = linearised(
                task.dynamics, torch.stack([ahead[i].mean for i in going]), torch.stack(actions)
            )
            unknown = torch.where(near.variance > 0, near.variance, self.process_noise.square())
            spread = near._replace(variance=unknown).carry(
                torch.stack([ahead[i].covariance for i in going])
            )
            for i, mean, covariance in zip(going, near.mean, spread, strict=True):
                ahead[i] = Estimate(mean, covariance)
        means = torch.stack([each.mean for each in ahead])
        outputs, measured = measured_near(task, means, observations)
        rows = zip(ahead, outputs.numpy(), measured.numpy(), strict=True)
        return [self._known(task, *row) for row in rows]

    def _known(self, task: Task, ahead: Estimate, outputs: Array, measured: Array) -> Estimate:
        """An estimate by what was measured, angles within half a turn of zero."""
        noise = self.noise.square().numpy()
        parts = ahead.mean.numpy(), ahead.covariance.numpy()
        mean, covariance, _ = measure(*parts, outputs, measured, noise)
        return Estimate(wrapped(task, torch.from_numpy(mean)), torch.from_numpy(covariance))


def measured_near(task: Task, states: Tensor, observations: Tensor) -> tuple[Tensor, Tensor]:
    """Outputs near ``N`` states as a linear function of these.

    Returns:
        Matrices ``N x m x state_dim``, and ``N x m`` of what was measured as it would be if
        outputs were these times the state; angles the shortest way from those of the states.
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


def wrapped(task: Task, states: Tensor) -> Tensor:
    r"""States whose angles are in :math:`(-\pi, \pi]`."""
    spec = task.dynamics.spec
    return spec.decode(spec.observe(states))
