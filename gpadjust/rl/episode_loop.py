"""Stable-Baselines3's loop of real episodes by itself."""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from gpadjust.checks import checked_whole

_FIXED = {
    "learning_starts": "random_steps",
    "gradient_steps": "the options of the planner or the search",
    "learning_rate": "PolicySearch(learning_rate=...)",
}


class EpisodeLoop(OffPolicyAlgorithm):
    """An off-policy algorithm of Stable-Baselines3 that makes real episodes and updates nothing.

    What improves in them is what a subclass says, as :class:`MPCAgent` does. It computes on the
    CPU, in double precision.

    Args:
        args: As of ``OffPolicyAlgorithm``.
        random_steps: Episodes that begin before so many real steps have random actions. (SB3's
            ``learning_starts`` would put off learning, too.)
        device: ``"cpu"``, which ``"auto"`` is, too.
        kwargs: As of ``OffPolicyAlgorithm``.

    Attributes:
        num_real_steps: How many real steps there were in all calls of ``learn``.

    Raises:
        TypeError: If ``random_steps`` is no whole number, or something is given that has no effect.
        ValueError: If ``random_steps`` is negative, or the device another one.
    """

    def __init__(
        self,
        *args: Any,
        random_steps: int = 0,
        device: torch.device | str = "auto",
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        checked_whole("random_steps", random_steps, 0)
        for name, instead in _FIXED.items():
            if name in kwargs:
                raise TypeError(
                    f"{type(self).__name__} has no {name}, as Stable-Baselines3 updates nothing "
                    f"here; give {instead} instead."
                )
        if device != "auto" and torch.device(device).type != "cpu":
            raise ValueError(
                f"{type(self).__name__} computes on the CPU, in double precision; found device "
                f"{str(device)!r}. Leave it out."
            )
        self.random_steps = random_steps
        self.num_real_steps = 0
        given = {**kwargs, "learning_rate": 0.0, "learning_starts": 0, "gradient_steps": 1}
        super().__init__(*args, **{**given, "device": "cpu", "support_multi_env": True})
        if _init_setup_model:
            self._setup_model()

    def begins_at_random(self) -> bool:
        """Whether an episode that begins now has random actions, as it was asked for."""
        return self.num_real_steps < self.random_steps

    def _on_step(self) -> None:
        super()._on_step()
        self.num_real_steps += self.n_envs

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Nothing is updated."""
