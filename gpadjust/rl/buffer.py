"""Real and model experience in one replay buffer, and the real episodes in time."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from gpadjust.checks import checked_number, checked_whole
from gpadjust.control.episodes import Row, nothing, recorded
from gpadjust.control.faults import fault


class MixedReplayBuffer(ReplayBuffer):
    """The replay buffer of Dyna: real experience D_R, and beside it model experience D_M.

    To Stable-Baselines3 it is the buffer of the real transitions. Every batch is drawn from both:
    of ``batch_size`` samples, ``batch_size * real_fraction`` are real, a fractional number being
    rounded up or down at random so that the mean is exact. As long as one of the buffers is empty,
    or ``mix`` is False, batches come from the real one, or from the model's if that is all there
    is. A real step that failed (:class:`gpadjust.control.StepGuard`) is not kept, and ends its
    episode; where other environments made theirs, its place takes a transition of one of them.

    Args:
        buffer_size: Capacity of the real buffer.
        args: As of Stable-Baselines3's ``ReplayBuffer``.
        real_fraction: Share of real samples in a batch, in [0, 1].
        model_buffer_size: Capacity of the model's buffer. Default: as ``buffer_size``.
        options: As of ``ReplayBuffer``, whose ``optimize_memory_usage`` must be False.

    Attributes:
        model_buffer: The model's transitions, a ``ReplayBuffer`` of one environment.
        episodes: All real episodes that have ended, with observations in the place of states.
        num_learnt: Number of their steps that the dynamics have learnt.
        mix: Whether batches hold model transitions.

    Raises:
        ValueError: If the fraction or a size is out of range.
    """

    def __init__(
        self,
        buffer_size: int,
        *args: Any,
        real_fraction: float = 1 / 11,
        model_buffer_size: int | None = None,
        **options: Any,
    ) -> None:
        self.real_fraction = checked_number("real_fraction", real_fraction, least=0, most=1)
        size = buffer_size if model_buffer_size is None else model_buffer_size
        super().__init__(buffer_size, *args, **options)
        spaces = self.observation_space, self.action_space
        self.model_buffer = ReplayBuffer(
            checked_whole("model_buffer_size", size, 1), *spaces, self.device
        )
        self.mix = True
        self.reset()

    def reset(self) -> None:
        """Forget all real and model experience."""
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
        if not failed.all():
            rows = np.where(failed, failed.argmin(), np.arange(self.n_envs))
            ends = done[rows], [infos[i] for i in rows]
            super().add(obs[rows], next_obs[rows], action[rows], reward[rows], *ends)

    def end_episodes(self) -> None:
        """End the episodes under way, by their newest steps."""
        for i in range(self.n_envs):
            self._end(i)

    def _end(self, i: int) -> None:
        rows, self._under_way[i] = self._under_way[i], []
        if rows:
            self.episodes = self.episodes.append(recorded(rows))

    def add_model_rows(self, *columns: np.ndarray) -> None:
        """Add ``N`` transitions of the model at once.

        Args:
            columns: Observations ``N x d``; the observations after them, also where an episode
                ended; actions scaled to [-1, 1], as SB3 stores them, ``N x a``; rewards ``N``;
                whether the episode ended; and whether it ended by a time limit alone.
        """
        rows, names = self.model_buffer, ("observations", "next_observations", "actions")
        n = min(len(columns[0]), rows.buffer_size)
        places = (rows.pos + np.arange(n)) % rows.buffer_size
        for name, values in zip((*names, "rewards", "dones", "timeouts"), columns, strict=True):
            getattr(rows, name)[places, 0] = values[len(values) - n :]
        rows.full = rows.full or rows.pos + n >= rows.buffer_size
        rows.pos = (rows.pos + n) % rows.buffer_size

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw a batch from both buffers, see Stable-Baselines3; the real samples come first."""
        if not self.mix or not self.model_buffer.size():
            return super().sample(batch_size, env)
        expected, num_real = batch_size * self.real_fraction, 0
        if self.size():
            num_real = int(expected) + int(np.random.random() < expected % 1)  # noqa: NPY002
        self.model_buffer.device = self.device  # which SB3 sets where it loads a buffer
        parts = [super().sample(num_real, env)] if num_real else []
        if num_real < batch_size:
            parts.append(self.model_buffer.sample(batch_size - num_real, env))
        names = ReplayBufferSamples._fields[:-1]  # the last is for n-step returns
        columns = [torch.cat([getattr(part, name) for part in parts]) for name in names]
        return ReplayBufferSamples(*columns)
