"""What a Dyna agent was given, checked before it learns."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, get_args

from stable_baselines3.common.vec_env import VecEnv

from gpadjust.dynamics import Dynamics
from gpadjust.dynamics.trajectory_information import check_informative
from gpadjust.rl.informative_trials import InformativeTrials
from gpadjust.rl.model_vec_env import Particles, check_function

if TYPE_CHECKING:
    from gpadjust.rl.dyna_sac import DynaSAC

FUNCTIONS = ("reward", "terminated", "initial_states")  # which are not saved
_NUMBERS: tuple[tuple[str, bool, int], ...] = (  # name, whether it is whole, the least
    ("explore_trials", True, 0),
    ("model_trials", True, 0),
    ("model_updates", False, 0),
    ("model_until", True, 0),
    ("trial_length", True, 1),
    ("num_particles", True, 1),
    ("reward_tolerance", False, 0),
)


def check_options(agent: DynaSAC, needed: tuple[str, ...]) -> None:
    """Whether an agent can learn with what it has.

    Args:
        agent: The agent.
        needed: Those of :data:`FUNCTIONS` that it was made with.

    Raises:
        ValueError: If something is missing, or out of range.
        TypeError: If something is of another kind.
    """
    for name in ("dynamics", *needed, "reward"):
        if getattr(agent, name) is None:
            raise ValueError(
                f"DynaSAC needs {name} to learn; found None. Pass {name}=... to DynaSAC or, as "
                "it is not saved, to DynaSAC.load. Without it the agent can only predict."
            )
    if not isinstance(agent.dynamics, Dynamics):
        raise TypeError(f"dynamics must be an object of a Dynamics; found {agent.dynamics!r}.")
    for name, arguments in zip(FUNCTIONS, (3, 1, 1), strict=True):
        check_function(getattr(agent, name), name, arguments)
    if agent.particles not in get_args(Particles):
        raise ValueError(
            f"Unknown particles {agent.particles!r}; use 'independent' or 'functions'."
        )
    for name, is_whole, least in _NUMBERS:
        value = getattr(agent, name)
        if value is None:
            continue
        if not isinstance(value, int if is_whole else (int, float)):
            whole = "whole " if is_whole else ""
            raise TypeError(f"{name} must be a {whole}number; found {value!r}.")
        if not value >= least:
            raise ValueError(f"{name} must be at least {least}; found {value}.")
    if agent.exploration is not None:
        if not isinstance(agent.exploration, InformativeTrials):
            raise TypeError(
                "exploration must be an object of InformativeTrials, or None; found "
                f"{agent.exploration!r}."
            )
        check_informative(agent.dynamics)


def time_limit(env: VecEnv) -> int:
    """Steps of a trial in an environment.

    Raises:
        ValueError: If it has no time limit that can be read.
    """
    spec = env.get_attr("spec")[0]
    length = None if spec is None else spec.max_episode_steps
    if length is None:
        # A TimeLimit that was put around an environment by hand.
        with suppress(AttributeError):
            length = env.get_attr("_max_episode_steps")[0]
    if length is None:
        raise ValueError(
            "The environment has no time limit that could be read; pass trial_length, the "
            "number of steps of a trial."
        )
    return int(length)
