"""The first trials of cart-poles, by the library's defaults."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from gpadjust.control import MPCAgent
from gpadjust.dynamics import PhysicsDynamics
from gpadjust.systems import cart_pole
from gpadjust.systems.swing_up import REAL_CART_POLE, equation_physics
from paper.common.experiment import Run, Table
from paper.common.tables import frame, groups, number, of, table
from paper.control import First


def run(experiment: First, model: str, seed: int) -> Run:
    """Make the trials; return the cost of each, and what the model promised of it."""
    system = cart_pole(seed)
    task = system.task()
    if model == "truth":
        task = system.task(PhysicsDynamics(system.spec, equation_physics(REAL_CART_POLE)))
    agent = MPCAgent(system.make(), task, seed=seed)
    length, costs, promises = agent.episode_length(), list[float](), list[float]()
    for _ in range(experiment.trials):
        agent.learn(length)
        costs.append(-agent.recorded_episodes(newest=length).rewards.mean().item())
        promised = agent.promised_reward
        promises.append(math.nan if promised is None else -promised)
    return {"trials": {"cost": costs, "promised": promises}}


def tables(runs: Sequence[Run], experiment: First) -> dict[str, Table]:
    """Return all tables, by name."""
    trials = frame(runs, "trials", "trial")
    columns: dict[str, Any] = {
        "runs": of("seed", "nunique", ".0f"),
        "cost": of("cost", "mean", ".3f"),
        "worst": of("cost", "max", ".3f"),
        "above 0.42": lambda rows: number((rows["cost"] > 0.42).sum(), ".0f"),
        "promised": of("promised", "mean", ".3f"),
    }
    labels, each = experiment.axes["model"], range(1, experiment.trials + 1)
    label = {(i, name): f"{text}, trial {i}" for i in each for name, text in labels.items()}
    text = table(groups(trials, ["trial", "model"], label), columns, "model")
    return {"trials": Table("Mean cost of a step, cart-pole", text)}
