"""What a replay buffer tells of the real episodes."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor

from gpadjust.control import Task
from gpadjust.dynamics import Dynamics, Trajectories
from gpadjust.physics import PhysicsError
from gpadjust.rl.buffer import MixedReplayBuffer
from gpadjust.states import StateSpec

_REACH = 10.0  # how many half ranges of the recorded states particles may be from their middle


class RecordedEpisodes:
    """The transitions in a replay buffer, as states and actions in the user's units.

    Rows are in the order of time, one environment after the other.

    Args:
        buffer: The buffer.
        policy: Knows the scale of the actions in the buffer.
        spec: Decodes the observations.
        newest: How many steps of each environment to take. Default: all.

    Attributes:
        states: ``N x state_dim``.
        actions: ``N x action_dim``.
        next_states: ``N x state_dim``.
        rewards: ``N``.
        terminated: Whether the next state ended the episode, ``N`` booleans.
        num_ended: How many episodes ended.
    """

    def __init__(
        self,
        buffer: MixedReplayBuffer,
        policy: BasePolicy,
        spec: StateSpec,
        newest: int | None = None,
    ) -> None:
        first = buffer.pos if buffer.full else 0
        rows = (first + np.arange(buffer.size())) % buffer.buffer_size
        rows = rows if newest is None else rows[len(rows) - min(newest, len(rows)) :]
        happened = ~buffer.failed[rows].T.flatten()

        def column(name: str) -> np.ndarray:
            values = getattr(buffer, name)[rows].swapaxes(0, 1)
            return values.reshape(-1, *values.shape[2:])[happened].astype(np.float64)

        self.spec = spec
        self.states = spec.decode(torch.from_numpy(column("observations")))
        self.next_states = spec.decode(torch.from_numpy(column("next_observations")))
        self.actions = torch.from_numpy(policy.unscale_action(column("actions")))
        self.rewards = torch.from_numpy(column("rewards"))
        dones = torch.from_numpy(column("dones"))
        self.terminated = (dones * (1 - torch.from_numpy(column("timeouts")))).bool()
        self.num_ended = int(dones.sum())
        ended = buffer.dones[rows].astype(bool).T
        starts = np.ones_like(ended)
        starts[:, 1:] = ended[:, :-1]
        self._episode = torch.from_numpy(starts.flatten().cumsum()[happened])
        if buffer.full and starts[:, 1:].any():
            starts[:, 0] = False  # what came before the oldest row is lost
        self._starts = torch.from_numpy(starts.flatten()[happened])
        # Those of an episode under way say nothing yet of how far one goes.
        whole = np.flip(np.maximum.accumulate(np.flip(ended, axis=1), axis=1), axis=1)
        self._whole = torch.from_numpy(whole.flatten()[happened])

    @property
    def num_transitions(self) -> int:
        """Number of rows."""
        return len(self.states)

    def draw_starts(self, n: int) -> Tensor:
        """Draw states at which episodes started, ``n x state_dim``, from PyTorch's generator."""
        starts = self.states[self._starts]
        return starts[torch.randint(len(starts), (n,))]

    def bounds(self) -> Tensor | None:
        """Bounds ``2 x state_dim`` far beyond what was seen in episodes that have ended.

        There are none of angles, constants and previous values; None if no episode has ended.
        """
        if not self._whole.any():
            return None
        seen = torch.cat([self.states[self._whole], self.next_states[self._whole]])
        low, high = seen.amin(0), seen.amax(0)
        reach = _REACH * (high - low) / 2
        reach[high == low] = torch.inf  # that it has not moved yet tells nothing
        for i, name in enumerate(self.spec.states):
            if name in (*self.spec.angles, *self.spec.exogenous, *self.spec.previous):
                reach[i] = torch.inf
        return torch.stack([(low + high) / 2 - reach, (low + high) / 2 + reach])

    def learnable(self, dynamics: Dynamics) -> Trajectories:
        """What happened, but for the states at which the physics fails.

        Raises:
            PhysicsError: If it does not say where, or everywhere.
        """
        works = torch.ones(self.num_transitions, dtype=torch.bool)
        while True:
            try:
                dynamics.try_physics(self.states[works], self.actions[works])
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
                parts = self.states, self.actions, self.next_states, self._episode
                return Trajectories(*parts).some(works)

    def check(self, task: Task, tolerance: float = 1e-3) -> None:
        """Compare the functions of a task with what was recorded.

        Args:
            task: The user's.
            tolerance: Greatest error of the reward, relative to the largest that was recorded.

        Raises:
            ValueError: If they differ; it shows the worst transition.
        """
        rewards = task.rewards(self.states, self.actions, self.next_states).double()
        error = (rewards - self.rewards).abs()
        if (error > tolerance * self.rewards.abs().max().clamp_min(1e-6)).any():
            i = int(error.argmax())
            raise ValueError(
                "reward(states, actions, next_states) is not the environment's: transition "
                f"{i} gave {self.rewards[i]:.6g}, but the function says {rewards[i]:.6g}; "
                f"{self._row(i)}. Correct the function, or the spec of the state (its order, and "
                "which entries are angles, seen as sine and then cosine). If rewards or "
                "observations are noisy, raise reward_tolerance; None checks nothing."
            )
        says = task.terminations(self.next_states)
        wrong = says != self.terminated
        if wrong.any():
            i = int(wrong.nonzero()[0])
            given = (
                "the function says" if task.terminated is not None else "none was given, that is"
            )
            raise ValueError(
                f"terminated(states) is not the environment's: transition {i} was recorded with "
                f"terminated={bool(self.terminated[i])}, but {given} {bool(says[i])}; "
                f"{self._row(i)}. Pass the termination that the environment has."
            )

    def _row(self, i: int) -> str:
        parts = ("states", "actions", "next_states")
        return ", ".join(f"{part}[{i}] = {getattr(self, part)[i].tolist()}" for part in parts)
