"""Searches in the known cart-pole, and learning on the true arm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gpadjust.control import CrossEntropy, Planner, Return, Task
from gpadjust.dynamics import PhysicsDynamics
from gpadjust.envs import CART_POLE_SPEC, cart_pole_reward
from gpadjust.envs.cart_pole.swing_up import MAX_FORCE
from gpadjust.envs.cart_pole.system import START_MEAN
from gpadjust.models.sampled_functions import seeded
from paper.arm import Arm
from paper.cartpole import Settings
from paper.common.experiment import Record
from paper.control import learner
from paper.floor import Floor


def run(experiment: Floor, system: str, seed: int, *, unfinished: Path) -> Record:
    """Find a floor: the cost of an episode, or the hand's error in cm over all steps."""
    if system == "arm":
        return _arm(experiment, seed, unfinished)
    from paper.cartpole.system import fixed_starts, true_physics

    settings = experiment.settings
    starts = fixed_starts(seed + 1) if "fixed" in system else torch.tensor([START_MEAN])
    task = Task(PhysicsDynamics(CART_POLE_SPEC, true_physics()), cart_pole_reward)
    planner = Planner(
        Return(),
        CrossEntropy(settings.rounds, num_elites=settings.elites),
        num_random=settings.sequences,
    )
    bounds = torch.tensor([[-MAX_FORCE], [MAX_FORCE]], dtype=torch.float64)
    length = Settings().episode_length
    with seeded(seed):
        plans = [
            planner.plan(task, starts[-1].double(), bounds, length)
            for _ in range(settings.restarts)
        ]
    plan = max(plans, key=lambda plan: plan.value)
    return {"found": -plan.value / length, "forces": plan.actions.squeeze(-1).tolist()}


def _arm(experiment: Floor, seed: int, unfinished: Path) -> dict[str, Any]:
    settings, arm = experiment.settings, Arm(out=experiment.out)
    every = max(1, settings.arm_episodes // 20)
    longer = replace(
        arm.settings,
        episodes=settings.arm_episodes,
        updates=settings.arm_updates,
        evaluate_every=every,
    )
    found = learner.run(replace(arm, settings=longer), "mf", seed, unfinished)["evaluations"]
    return {"found": min(found["all_steps"]), "all_steps": found["all_steps"]}
