"""How agents learn and use their models."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import get_args

from gpadjust.checks import check_choice, check_switch, checked_number, checked_whole
from gpadjust.dynamics.free_run import checked_horizons
from gpadjust.rl.model_vec_env import Sampling

_WHOLE = {  # the least of each
    "model_episodes": 0,
    "last_model_episode": 0,
    "model_buffer_size": 1,
    "num_particles": 1,
}


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """How a model is learnt from real episodes.

    Args:
        reward_tolerance: How far the known rewards may be from the recorded ones, relative to the
            largest of an episode; None to check neither rewards nor terminations, as noisy sensors
            may need.
        score_horizons: Numbers of steps over which each new episode is predicted before it is
            learnt, open loop along its actions, to log how well (``model/coverage_15``). Some half
            a second, and with a physics that is costly its evaluation at 39 particles of 4 windows
            a step; () does without.

    Raises:
        TypeError: If something is of another kind.
        ValueError: If a number is out of range.
    """

    reward_tolerance: float | None = 1e-3
    score_horizons: tuple[int, ...] = (1, 5, 15)

    def __post_init__(self) -> None:
        """Check them."""
        if self.reward_tolerance is not None:
            checked_number("reward_tolerance", self.reward_tolerance, least=0)
        if self.score_horizons != ():
            object.__setattr__(self, "score_horizons", checked_horizons(self.score_horizons))

    def uses_model(self, num_episodes: int) -> bool:
        """Whether the model serves after so many real episodes."""
        return True


@dataclass(frozen=True, kw_only=True)
class DynaOptions(ModelOptions):
    """How a Dyna agent uses its model.

    Args:
        model_episodes: Model episodes for each real one.
        updates_per_model_step: Gradient steps for each model step; may be fractional, such as 0.5.
        last_model_episode: Number of real episodes after which the model is neither fitted nor run,
            and its experience is kept out of the batches, unless ``keep_model_data``; 0 never uses
            the model. Default: it always serves.
        keep_model_data: Whether batches hold model experience after ``last_model_episode``.
        refresh_model_data: Whether the transitions that earlier models made are made again by the
            newest one, from the same states and actions, as soon as it is fitted. What the first
            models got wrong would mislead the agent for long. It costs a prediction of the whole
            model buffer after each real episode. (The paper does not have it.)
        real_fraction: Share of real transitions in a batch, see :class:`MixedReplayBuffer`. The
            default, a real one for ten of the model, is what a uniform draw from both buffers would
            give with ten model episodes for each real one. (MBPO has 1/20; Janner et al. 2019.)
        model_buffer_size: How many model transitions are kept. Default: as ``buffer_size``.
        reward_tolerance: See :class:`ModelOptions`, like ``score_horizons``.
        num_particles: Model episodes that run side by side. Default: all.
        sampling: How they are sampled, by ``"step"`` or ``"trajectory"``, see
            :class:`ModelVecEnv`.

    Raises:
        TypeError: If something is of another kind.
        ValueError: If something is out of range.
    """

    model_episodes: int = 20
    updates_per_model_step: float = 1.0
    last_model_episode: int | None = None
    keep_model_data: bool = False
    refresh_model_data: bool = True
    real_fraction: float = 1 / 11
    model_buffer_size: int | None = None
    num_particles: int | None = None
    sampling: Sampling = "step"

    def __post_init__(self) -> None:
        """Check them."""
        super().__post_init__()
        optional = {entry.name for entry in fields(self) if entry.default is None}
        for name, least in _WHOLE.items():
            value = getattr(self, name)
            if value is None and name in optional:
                continue
            checked_whole(name, value, least)
        checked_number("updates_per_model_step", self.updates_per_model_step, least=0)
        checked_number("real_fraction", self.real_fraction, least=0, most=1)
        for name in ("keep_model_data", "refresh_model_data"):
            check_switch(name, getattr(self, name))
        check_choice("sampling", self.sampling, get_args(Sampling))

    def uses_model(self, num_episodes: int) -> bool:
        """Whether the model serves after so many real episodes."""
        return self.last_model_episode is None or num_episodes < self.last_model_episode
