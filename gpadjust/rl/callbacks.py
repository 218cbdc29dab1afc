"""Callbacks that know of the model."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from gpadjust.rl.dyna_sac import DynaSAC


class DynaCallback(BaseCallback):
    """A Stable-Baselines3 callback with two more hooks, for :class:`DynaSAC`.

    Subclasses that override ``_init_callback`` must call that of this class.
    """

    model: DynaSAC

    def _init_callback(self) -> None:
        if not isinstance(self.model, DynaSAC):
            raise TypeError(
                f"{type(self).__name__} is for DynaSAC; found {type(self.model).__name__}."
            )
        self.model.model_hooks.append(self)

    def _on_step(self) -> bool:
        return True

    def on_model_fit(self, metrics: dict[str, float]) -> None:
        """Called after the dynamics were fitted.

        Args:
            metrics: ``"fit_seconds"``; and of the newest real transitions, predicted before they
                were learnt, from the second trial on: ``"nlpd"`` and ``"coverage"``, averaged over
                the states, and ``"rmse/<state>"`` of each.
        """

    def on_model_trials(self, returns: np.ndarray) -> None:
        """Called after some model trials that ran side by side.

        Args:
            returns: The sum of rewards of each.
        """
