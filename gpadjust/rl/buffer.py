"""Real and model experience in one replay buffer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from gpadjust.checks import checked_number, checked_whole
from gpadjust.control.faults import fault
from gpadjust.dynamics import Trajectories
from gpadjust.states import StateSpec


class CompactReplayBuffer(ReplayBuffer):
    """A ``ReplayBuffer`` that takes many rows at once, and saves only those that are filled."""

    rows: ClassVar[tuple[str, ...]] = (
        "observations",
        "next_observations",
        "actions",
        "rewards",
        "dones",
        "timeouts",
    )

    def add_rows(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        dones: np.ndarray,
        timeouts: np.ndarray,
    ) -> None:
        """Add ``N`` transitions of one environment at once.

        Args:
            obs: Observations, ``N x d``.
            next_obs: The observations after them, ``N x d``, also where an episode ended.
            actions: Actions scaled to [-1, 1], as SB3 stores them, ``N x a``.
            rewards: ``N`` rewards.
            dones: Whether the episode ended, ``N``.
            timeouts: Whether it ended by a time limit alone, ``N``.
        """
        if self.n_envs != 1:
            raise ValueError(f"add_rows() is for buffers of one environment; found {self.n_envs}.")
        columns = (obs, next_obs, actions, rewards, dones, timeouts)
        n = min(len(obs), self.buffer_size)
        places = (self.pos + np.arange(n)) % self.buffer_size
        for name, values in zip(self.rows, columns, strict=True):
            getattr(self, name)[places, 0] = values[len(values) - n :]
        self.full = self.full or self.pos + n >= self.buffer_size
        self.pos = (self.pos + n) % self.buffer_size

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes, of the rows those that are filled."""
        rows = {name: getattr(self, name)[: self.size()] for name in self.rows}
        return {**self.__dict__, **rows}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the attributes back, with space for the other rows."""
        self.__dict__.update(state)
        for name in self.rows:
            rows = np.zeros((self.buffer_size, *state[name].shape[1:]), dtype=state[name].dtype)
            rows[: len(state[name])] = state[name]
            setattr(self, name, rows)


class MixedReplayBuffer(CompactReplayBuffer):
    """The replay buffer of Dyna: real experience D_R, and beside it model experience D_M.

    To Stable-Baselines3 it is the buffer of the real transitions. The attribute ``model_buffer`` is
    one of the others. Every batch is drawn from both: of ``batch_size`` samples,
    ``batch_size * real_fraction`` are real, a fractional number being rounded up or down at random
    so that the mean is exact. As long as one of the buffers is empty, or ``mix`` is False, batches
    come from the real one, or from the model's if that is all there is.

    A real step whose ``info["step_failed"]`` is true did not happen, as where a simulator failed.
    It is not kept: the step before it is the last one of its episode, truncated. (Where other
    environments made theirs, its place in the row repeats another transition.) Nor is one that
    cannot be data, of an environment without a :class:`gpadjust.control.StepGuard`.

    Args:
        buffer_size: Capacity of the real buffer.
        args: As of Stable-Baselines3's ``ReplayBuffer``: a one-dimensional ``Box`` of observations,
            a ``Box`` of actions, and the device, for example.
        real_fraction: Share of real samples in a batch, in [0, 1].
        model_buffer_size: Capacity of the model's buffer. Default: as ``buffer_size``.
        options: As of ``ReplayBuffer``; ``optimize_memory_usage`` must be False.

    Attributes:
        model_buffer: The model's transitions.
        failed: Which places repeat another transition, ``buffer_size x n_envs`` booleans.
        learnt: Which places the dynamics have learnt, ``buffer_size x n_envs`` booleans.
        mix: Whether batches hold model transitions.
        real_fraction: Share of real samples in a batch.

    Raises:
        ValueError: If the fraction or the size is out of range, or ``optimize_memory_usage`` is
            asked for.
    """

    rows = (*CompactReplayBuffer.rows, "failed", "learnt")

    def __init__(
        self,
        buffer_size: int,
        *args: Any,
        real_fraction: float = 1 / 11,
        model_buffer_size: int | None = None,
        **options: Any,
    ) -> None:
        checked_number("real_fraction", real_fraction, least=0, most=1)
        if model_buffer_size is not None:
            checked_whole("model_buffer_size", model_buffer_size, 1)
        if options.get("optimize_memory_usage"):
            raise ValueError(
                "MixedReplayBuffer does not support optimize_memory_usage=True: model transitions "
                "do not lie in the order of a trajectory."
            )
        super().__init__(buffer_size, *args, **options)
        self.real_fraction = real_fraction
        self.mix = True
        self.failed = np.zeros((self.buffer_size, self.n_envs), dtype=bool)
        self.learnt = np.zeros_like(self.failed)
        size = buffer_size if model_buffer_size is None else model_buffer_size
        spaces = (self.observation_space, self.action_space)
        self.model_buffer = CompactReplayBuffer(size, *spaces, self.device)

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
        steps = zip(infos, np.stack([obs, next_obs], 1), reward, strict=True)
        failed = np.array([bool(info.get("step_failed") or fault(*step)) for info, *step in steps])
        if failed.any():
            self.end_episodes(failed)
        if failed.all():
            return
        pos = self.pos
        super().add(obs, next_obs, action, reward, done, infos)
        self.failed[pos], self.learnt[pos] = failed, False
        for i in failed.nonzero()[0]:
            # Its place in the row is taken by a transition that is sampled once more.
            row, env = (pos - 1, i) if self.size() > 1 else (pos, int(failed.argmin()))
            for name in CompactReplayBuffer.rows:
                getattr(self, name)[pos, i] = getattr(self, name)[row, env]
            if not self.dones[pos, i]:
                self.dones[pos, i] = self.timeouts[pos, i] = 1

    def end_episodes(self, environments: np.ndarray) -> None:
        """Let the newest steps of some environments be the last ones of episodes, truncated.

        Args:
            environments: Which of them, ``n_envs`` booleans.
        """
        if not self.size():
            return
        ended = environments & (self.dones[self.pos - 1] == 0)
        self.dones[self.pos - 1][ended] = self.timeouts[self.pos - 1][ended] = 1

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw a batch from both buffers; the real samples come first.

        Args:
            batch_size: Number of samples.
            env: Normalises observations and rewards, see Stable-Baselines3.
        """
        if not self.mix or not self.model_buffer.size():
            return super().sample(batch_size, env)
        if not self.size():
            return self.model_buffer.sample(batch_size, env)
        expected = batch_size * self.real_fraction
        num_real = int(expected) + int(np.random.random() < expected % 1)  # noqa: NPY002
        parts = []
        if num_real:
            parts.append(super().sample(num_real, env))
        if num_real < batch_size:
            parts.append(self.model_buffer.sample(batch_size - num_real, env))
        names = ReplayBufferSamples._fields[:-1]  # the last is for n-step returns
        columns = [torch.cat([getattr(part, name) for part in parts]) for name in names]
        return ReplayBufferSamples(*columns)

    def reset(self) -> None:
        """Empty both buffers."""
        super().reset()
        self.model_buffer.reset()
        self.failed[:] = self.learnt[:] = False

    @property
    def whole(self) -> np.ndarray:
        """Which places are of episodes that have ended, ``buffer_size x n_envs`` booleans."""
        places, ended = self._in_time()
        whole = np.zeros_like(self.failed)
        whole[places] = np.flip(np.maximum.accumulate(np.flip(ended, axis=0), axis=0), axis=0)
        return whole

    def recorded(
        self,
        spec: StateSpec,
        unscale_action: Callable[[np.ndarray], np.ndarray],
        keep: np.ndarray | None = None,
    ) -> Trajectories:
        """Return whole real episodes in the user's units, one environment after the other.

        The oldest one of a full buffer is left out, as its beginning may be lost, unless it is the
        only one.

        Args:
            spec: The entries of states and actions.
            unscale_action: The inverse of the scale of the actions in the buffer.
            keep: Which places to take, ``buffer_size x n_envs`` booleans. Default: all.
        """
        places, ended = self._in_time()
        episode = ended.cumsum(0) - ended
        lost = self.full & (ended.sum(0) > 1) & (episode == 0)
        chosen = self.whole & ~self.failed & (True if keep is None else keep)
        taken = (chosen[places] & ~lost).T.flatten()
        episode = episode + np.arange(self.n_envs) * (len(places) + 1)

        def column(values: np.ndarray) -> torch.Tensor:
            values = values.swapaxes(0, 1)  # one environment after the other
            return torch.from_numpy(values.reshape(-1, *values.shape[2:])[taken])

        def numbers(name: str) -> torch.Tensor:
            return column(getattr(self, name)[places].astype(np.float64))

        return Trajectories(
            spec.decode(numbers("observations")),
            torch.from_numpy(unscale_action(numbers("actions").numpy())),
            spec.decode(numbers("next_observations")),
            column(episode),
            numbers("rewards"),
            (numbers("dones") * (1 - numbers("timeouts"))).bool(),
        )

    def _in_time(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the filled places from the oldest on, and whether episodes end there."""
        first = self.pos if self.full else 0
        places = (first + np.arange(self.size())) % self.buffer_size
        return places, self.dones[places].astype(bool)
