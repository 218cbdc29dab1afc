"""Costs at best: searches in the known cart-pole, long learning on the true arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from gpadjust.control import CrossEntropy, Planner, Return, Task
from gpadjust.dynamics import PhysicsDynamics
from gpadjust.models.sampled_functions import seeded
from gpadjust.systems.swing_up import CART_POLE_SPEC, MAX_FORCE, START_MEAN, cart_pole_reward
from paper.cartpole import Floor, Settings
from paper.cartpole.system import fixed_starts, true_physics
from paper.common.experiment import Run, Table
from paper.common.tables import frame, groups, of, table


def run(experiment: Floor, system: str, seed: int) -> Run:
    """Find a floor: the cost of an episode, or the hand's error in cm over all steps."""
    if system == "arm":
        return _arm(experiment, seed)
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


def _arm(experiment: Floor, seed: int) -> Run:
    from paper.arm import Arm

    settings, arm = experiment.settings, Arm(out=experiment.out)
    longer = replace(
        arm.settings,
        episodes=settings.arm_episodes,
        updates=settings.arm_updates,
        evaluate_every=max(1, settings.arm_episodes // 20),
    )
    found = replace(arm, settings=longer).run("mf", seed)["evaluations"]
    return {"found": min(found["all_steps"]), "all_steps": found["all_steps"]}


def tables(runs: Sequence[Run], experiment: Floor) -> dict[str, Table]:
    """All tables, by name."""
    columns = {
        "runs": len,
        "mean": of("found"),
        "least": of("found", "min"),
        "most": of("found", "max"),
    }
    rows = groups(frame(runs), "system", experiment.axes["system"])
    return {"floors": Table("Floors", table(rows, columns))}
