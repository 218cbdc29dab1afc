"""Callbacks that know of the model."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback


class DynaCallback(BaseCallback):
    """A Stable-Baselines3 callback with two more hooks, for :class:`~gpadjust.rl.Dyna` agents.

    Subclasses that override ``_init_callback`` must call that of this class.
    """

    def _init_callback(self) -> None:
        hooks = getattr(self.model, "model_hooks", None)
        if hooks is None:
            raise TypeError(
                f"{type(self).__name__} is for Dyna agents, such as DynaSAC; found "
                f"{type(self.model).__name__}."
            )
        hooks.append(self)

    def _on_step(self) -> bool:
        return True

    def on_model_fit(self, metrics: dict[str, float]) -> None:
        """Called after the dynamics were fitted.

        Args:
            metrics: ``"fit_seconds"``; and of the newest real transitions, predicted before they
                were learnt, as soon as the dynamics can predict: ``"nlpd"`` and ``"coverage"``,
                averaged over the states, and ``"rmse/<state>"`` of each.
        """

    def on_model_episodes(self, returns: np.ndarray) -> None:
        """Called after some model episodes that ran side by side.

        Args:
            returns: The sum of rewards of each.
        """
