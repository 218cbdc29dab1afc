"""Options of Dyna agents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from gpadjust.checks import check_choice, check_switch, checked_number, checked_whole
from gpadjust.dynamics.base import checked_horizons
from gpadjust.rl.model_vec_env import Sampling


@dataclass(frozen=True, kw_only=True)
class DynaOptions:
    """Options of a Dyna agent and its model.

    Args:
        model_episodes: Number of model episodes for each real one.
        updates_per_model_step: Gradient steps for each model step; may be fractional, such as 0.5.
        last_model_episode: Number of real episodes after which the model is neither fitted nor run,
            and batches have real samples only; 0 never uses the model. Default: no limit.
        refresh_model_data: If True, the model predicts the transitions of earlier models again,
            from the same states and actions, after each fit: errors of the first models would
            mislead the agent for long. (The paper does not have it.)
        real_fraction: Share of real transitions in a batch, see :class:`MixedReplayBuffer`. By
            default twice as many as in a uniform draw with ``model_episodes=20``. (MBPO has 1/20;
            Janner et al. 2019.)
        num_particles: Number of parallel model episodes. Default: all.
        sampling: As of :class:`ModelVecEnv`.
        reward_tolerance: As of :class:`gpadjust.control.Agent`.
        score_horizons: As of :class:`gpadjust.control.Agent`; the log has the scores
            (``model/coverage_15``).

    Raises:
        TypeError, ValueError: If an option has another type, or is out of range.
    """

    model_episodes: int = 20
    updates_per_model_step: float = 1.0
    last_model_episode: int | None = None
    refresh_model_data: bool = True
    real_fraction: float = 1 / 11
    num_particles: int | None = None
    sampling: Sampling = "step"
    reward_tolerance: float | None = 1e-3
    score_horizons: tuple[int, ...] = (1, 5, 15)

    def __post_init__(self) -> None:
        """Check the options."""
        checked_whole("model_episodes", self.model_episodes, 0)
        for name, least in (("last_model_episode", 0), ("num_particles", 1)):
            if getattr(self, name) is not None:
                checked_whole(name, getattr(self, name), least)
        checked_number("updates_per_model_step", self.updates_per_model_step, least=0)
        check_switch("refresh_model_data", self.refresh_model_data)
        check_choice("sampling", self.sampling, get_args(Sampling))
        if self.reward_tolerance is not None:
            checked_number("reward_tolerance", self.reward_tolerance, least=0)
        if self.score_horizons != ():
            object.__setattr__(self, "score_horizons", checked_horizons(self.score_horizons))
