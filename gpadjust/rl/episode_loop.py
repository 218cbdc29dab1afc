"""Stable-Baselines3's loop of real episodes by itself."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm


class EpisodeLoop(OffPolicyAlgorithm):
    """An off-policy algorithm of Stable-Baselines3 that makes real episodes and updates nothing.

    What improves in them is what a subclass says, as :class:`MPCAgent` does.

    Args:
        args: As of ``OffPolicyAlgorithm``.
        kwargs: As of ``OffPolicyAlgorithm``.
    """

    def __init__(self, *args: Any, _init_setup_model: bool = True, **kwargs: Any) -> None:
        fixed = {"learning_starts": 0, "gradient_steps": 1, "support_multi_env": True}
        super().__init__(*args, **{**kwargs, **fixed})
        if _init_setup_model:
            self._setup_model()

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Nothing is updated."""
