"""A learner, and the settings that learners share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gpadjust.dynamics import Dynamics
from gpadjust.rl import InformativeTrials


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is the same in every scenario, unless it says otherwise.

    The defaults were tuned on the cart-pole with its true dynamics as the model.
    """

    num_trials: int
    trial_length: int
    model_trials: int = 20  # after each of the first model_until trials
    model_until: int
    model_updates: float = 2  # gradient steps for each step in the model
    num_particles: int = 5
    later_updates: int  # gradient steps after each trial after model_until
    learning_rate: float = 3e-3
    gamma: float = 0.95
    tau: float = 0.02
    batch_size: int = 256
    net_arch: tuple[int, ...] = (128, 128)
    ent_coef: str = "auto_0.3"
    target_entropy: str | float = "auto"

    def matched_updates(self) -> int:
        """The updates that a scenario with a model makes after each trial until model_until."""
        steps = self.trial_length
        return round(steps + self.model_updates * self.model_trials * steps)


@dataclass(frozen=True)
class Scenario:
    """A learner.

    Args:
        label: Its name in tables and figures.
        dynamics: Makes the model, from what the experiment gives; None for a model-free learner.
        model_updates: In place of the shared number.
        updates: Of a model-free learner, the gradient steps after each of all trials. Default:
            as many as the others make.
        max_runs: The most seeds that it is run with.
        exploration: How real trials are planned. Default: the policy acts in all.
        explore_trials: Of how many trials after the first that is.
    """

    label: str
    dynamics: Callable[..., Dynamics] | None
    model_updates: float | None = None
    updates: int | None = None
    max_runs: int | None = None
    exploration: InformativeTrials | None = None
    explore_trials: int = 0


def agent_options(scenario: Scenario, settings: Settings) -> dict[str, Any]:
    """The arguments of DynaSAC that scenario and settings decide."""
    chosen = scenario.model_updates
    return {
        "model_trials": settings.model_trials,
        "model_updates": settings.model_updates if chosen is None else chosen,
        "model_until": 0 if scenario.dynamics is None else settings.model_until,
        "trial_length": settings.trial_length,
        "num_particles": settings.num_particles,
        "exploration": scenario.exploration,
        "explore_trials": scenario.explore_trials,
        "learning_rate": settings.learning_rate,
        "gamma": settings.gamma,
        "tau": settings.tau,
        "batch_size": settings.batch_size,
        "ent_coef": settings.ent_coef,
        "target_entropy": settings.target_entropy,
        "policy_kwargs": {
            "net_arch": list(settings.net_arch),
            "optimizer_kwargs": {"fused": True},
        },
        "device": "cpu",
    }


def updates_on_trial(scenario: Scenario, settings: Settings, trial: int) -> int:
    """Gradient steps after this real trial (from 1), without those within the model."""
    if scenario.dynamics is None and scenario.updates is not None:
        return scenario.updates
    if trial > settings.model_until:
        return settings.later_updates
    if scenario.dynamics is None:
        return settings.matched_updates()
    return settings.trial_length
