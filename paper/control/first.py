"""The first trials of cart-poles, by the library's defaults."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

from gpadjust.control import MPCAgent
from gpadjust.dynamics import PhysicsDynamics
from gpadjust.systems import cart_pole
from gpadjust.systems.swing_up import REAL_CART_POLE, cart_pole_spec, equation_physics
from paper.common.experiment import Run, Table
from paper.common.tables import frame, groups, number, of, table
from paper.control import First


def run(experiment: First, model: str, seed: int) -> Run:
    """Make the trials; return the cost of each, and what the model promised of it."""
    warnings.filterwarnings("ignore", message="A step of the last|The best plan|An episode came")
    system = cart_pole(seed)
    env, task = system.make(), system.task()
    if model == "truth":
        spec = cart_pole_spec()
        physics = equation_physics(REAL_CART_POLE)
        task = system.task(PhysicsDynamics(spec, physics))
    agent = MPCAgent(env, task, seed=seed)
    length, costs, promises = agent.episode_length(), list[float](), list[float]()
    for _ in range(experiment.trials):
        agent.learn(length)
        costs.append(-agent.recorded_episodes(newest=length).rewards.mean().item())
        promised = agent.promised_reward
        promises.append(math.nan if promised is None else -promised)
    return {"trials": {"cost": costs, "promised": promises}}


def tables(runs: Sequence[Run], experiment: First) -> dict[str, Table]:
    """All tables, by name."""
    trials = frame(runs, "trials", "trial")
    columns: dict[str, Any] = {
        "runs": of("seed", "nunique", ".0f"),
        "cost": of("cost", "mean", ".3f"),
        "worst": of("cost", "max", ".3f"),
        "above 0.42": lambda rows: number((rows["cost"] > 0.42).sum(), ".0f"),
        "promised": of("promised", "mean", ".3f"),
    }
    parts = []
    for trial in range(1, experiment.trials + 1):
        own = trials[trials["trial"] == trial]
        labels = {k: f"{v}, trial {trial}" for k, v in experiment.axes["model"].items()}
        parts.append(table(groups(own, "model", labels), columns, "model").splitlines())
    text = "\n".join([*parts[0], *(line for part in parts[1:] for line in part[2:])])
    return {"trials": Table("Mean cost of a step, cart-pole", text)}
