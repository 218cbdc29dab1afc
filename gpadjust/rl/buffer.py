"""Real and model experience in one replay buffer, with the sequence of real episodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from gpadjust.checks import checked_number
from gpadjust.control.episodes import Row, fault, nothing, recorded


class MixedReplayBuffer(ReplayBuffer):
    """The replay buffer of Dyna: real experience D_R and model experience D_M.

    For Stable-Baselines3 it is the buffer of the real transitions. Every batch has samples of both:
    of ``batch_size`` samples, ``batch_size * real_fraction`` are real, rounded up or down at random
    so that the mean is exact. If one of the buffers is empty, all samples come from the other; if
    ``mix`` is False, from the real one. A failed real step (:class:`gpadjust.control.StepGuard`) is
    not stored, and ends its episode; if steps of other environments succeeded, a copy of one of
    them takes its place.

    Args:
        buffer_size: Capacity of the real buffer, and of the model's.
        args: As of Stable-Baselines3's ``ReplayBuffer``.
        real_fraction: Share of real samples in a batch, in [0, 1].
        options: As of ``ReplayBuffer``, with ``optimize_memory_usage=False``.

    Attributes:
        model_buffer: The model's transitions, a ``ReplayBuffer`` of one environment.
        episodes: All real episodes that have ended, with observations in place of states.
        num_learnt: Number of their steps in updates of the dynamics.
        mix: If True, batches contain model transitions.

    Raises:
        ValueError: If the fraction is out of range.
    """

    def __init__(
        self,
        buffer_size: int,
        *args: Any,
        real_fraction: float = 1 / 11,
        **options: Any,
    ) -> None:
        self.real_fraction = checked_number("real_fraction", real_fraction, least=0, most=1)
        super().__init__(buffer_size, *args, **options)
        spaces = self.observation_space, self.action_space
        self.model_buffer = ReplayBuffer(buffer_size, *spaces, self.device)
        self.mix = True
        self.reset()

    def reset(self) -> None:
        """Remove all real and model experience."""
        super().reset()
        self.model_buffer.reset()
        self.episodes = nothing(int(np.prod(self.obs_shape)), self.action_dim)
        self.num_learnt = 0
        self._under_way: list[list[Row]] = [[] for _ in range(self.n_envs)]

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Add a real step of each environment, see Stable-Baselines3."""
        # SB3 scales actions to [-1, 1].
        space: Any = self.action_space
        actions = space.low + (np.float64(action) + 1) / 2 * (space.high - space.low)
        failed = np.zeros(self.n_envs, dtype=bool)
        for i, info in enumerate(infos):
            failed[i] = info.get("step_failed") or fault([obs[i], next_obs[i]], reward[i])
            if not failed[i]:
                terminated = done[i] and not info.get("TimeLimit.truncated", False)
                row = obs[i].copy(), actions[i], next_obs[i].copy(), reward[i], terminated
                self._under_way[i].append(row)
            if failed[i] or done[i]:
                self._end(i)
        if not failed.all():  # SB3 stores a step of each environment: repeat a valid one
            rows = np.where(failed, failed.argmin(), np.arange(self.n_envs))
            ends = done[rows], [infos[i] for i in rows]
            super().add(obs[rows], next_obs[rows], action[rows], reward[rows], *ends)

    def end_episodes(self) -> None:
        """End the episodes under way at their newest steps."""
        for i in range(self.n_envs):
            self._end(i)

    def _end(self, i: int) -> None:
        """End the episode of an environment."""
        rows = self._under_way[i]
        self._under_way[i] = []
        if rows:
            self.episodes = self.episodes.append(recorded(rows))

    def add_model_rows(self, *columns: np.ndarray) -> None:
        """Add ``N`` transitions of the model at once.

        The columns are observations ``N x d``; next observations, also at the end of an episode;
        actions scaled to [-1, 1] ``N x a``; rewards, ends of episodes, and ends by a time limit
        alone, ``N`` each.
        """
        buffer = self.model_buffer
        n = min(len(columns[0]), buffer.buffer_size)
        # A ring: the newest rows replace the oldest.
        places = (buffer.pos + np.arange(n)) % buffer.buffer_size
        names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
        for name, values in zip(names, columns, strict=True):
            getattr(buffer, name)[places, 0] = values[len(values) - n :]
        buffer.full = buffer.full or buffer.pos + n >= buffer.buffer_size
        buffer.pos = (buffer.pos + n) % buffer.buffer_size

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw a batch from both buffers, see Stable-Baselines3; real samples come first."""
        if not self.mix or not self.model_buffer.size():
            return super().sample(batch_size, env)
        num_real = 0
        if self.size():  # rounded at random, so that the mean is batch_size * real_fraction
            expected = batch_size * self.real_fraction
            num_real = int(expected) + int(np.random.random() < expected % 1)  # noqa: NPY002
        self.model_buffer.device = self.device  # SB3 sets it when it loads a buffer
        parts = []
        if num_real:
            parts.append(super().sample(num_real, env))
        if num_real < batch_size:
            parts.append(self.model_buffer.sample(batch_size - num_real, env))
        names = ReplayBufferSamples._fields[:-1]  # the last one is for n-step returns
        columns = [torch.cat([getattr(part, name) for part in parts]) for name in names]
        return ReplayBufferSamples(*columns)
