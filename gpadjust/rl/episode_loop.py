"""Stable-Baselines3's loop of real episodes by itself."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from gpadjust.control.option_checks import check_whole


class EpisodeLoop(OffPolicyAlgorithm):
    """An off-policy algorithm of Stable-Baselines3 that makes real episodes and updates nothing.

    What improves in them is what a subclass says, as :class:`MPCAgent` does.

    Args:
        args: As of ``OffPolicyAlgorithm``.
        random_steps: Episodes that begin before so many real steps have random actions. (SB3's
            ``learning_starts`` would put off learning, too.)
        kwargs: As of ``OffPolicyAlgorithm``.

    Raises:
        TypeError: If ``random_steps`` is no whole number.
        ValueError: If it is negative.
    """

    def __init__(
        self,
        *args: Any,
        random_steps: int = 0,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        check_whole("random_steps", random_steps, 0)
        self.random_steps = random_steps
        fixed = {"learning_starts": 0, "gradient_steps": 1, "support_multi_env": True}
        super().__init__(*args, **{**kwargs, **fixed})
        if _init_setup_model:
            self._setup_model()

    def begins_at_random(self) -> bool:
        """Whether an episode that begins now has random actions, as it was asked for."""
        return self.num_timesteps < self.random_steps

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Nothing is updated."""
