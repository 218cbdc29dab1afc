"""What is written down of each trial."""

from __future__ import annotations

from typing import Any

from paper.cartpole.recorder import CartPoleRecorder
from paper.exploration.held_out import errors


class ExplorationRecorder(CartPoleRecorder):
    """Records also how well the model that has learnt from a trial predicts the test trials."""

    def of_policy(self, trial: int) -> dict[str, Any]:
        """The deterministic policy's cost, and the errors of the newest model."""
        assert self.model.dynamics is not None
        found = errors(self.model.dynamics)
        return {
            **super().of_policy(trial),
            "error": found["swing-up"],
            "error_random": found["random"],
        }
