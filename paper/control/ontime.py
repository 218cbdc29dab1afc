"""How long decisions take that have a time, and what they cost."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gpadjust.control import Agent, MPCAgent, Planner
from gpadjust.control.mpc import EACH_STEP
from gpadjust.systems import cart_pole
from paper.common.experiment import Run, Table
from paper.common.tables import frame, groups, of, table
from paper.control import Ontime


def run(experiment: Ontime, seconds: str, seed: int) -> Run:
    """Learn from random trials, and then plan some in time; return cost and times of each."""
    warnings.filterwarnings("ignore", message="A step of the last|The best plan|An episode came")
    settings, system = experiment.settings, cart_pole(seed)
    budget = None if seconds == "none" else float(seconds)
    each_step: Planner = replace(EACH_STEP, horizon=settings.horizon, seconds=budget)
    env, length, rows = system.make(), 25, list[dict[str, float]]()
    random_steps = settings.random_trials * length
    agent = MPCAgent(env, system.task(), each_step, random_steps=random_steps, seed=seed)
    for trial in range(settings.random_trials + settings.trials):
        times: list[float] = [agent.wall_time["plan"]]

        def watch(agent: Agent, event: str, values: Any, times: list[float] = times) -> None:
            if event == "step":
                times.append(agent.wall_time["plan"])

        agent.learn(length, watch)
        if trial >= settings.random_trials:
            first, *later = np.diff(times)
            cost = -agent.recorded_episodes(newest=length).rewards.mean().item()
            rows.append(
                {
                    "cost": cost,
                    "median": float(np.median(later)),
                    "most": float(np.quantile(later, 0.99)),
                    "first": float(first),
                }
            )
    return {"trials": {name: [row[name] for row in rows] for name in rows[0]}}


def tables(runs: Sequence[Run], experiment: Ontime) -> dict[str, Table]:
    """All tables, by name."""
    trials = frame(runs, "trials", "trial")
    columns = {
        "trials": of("cost", "count", ".0f"),
        "mean cost of a step": of("cost", "mean", ".3f"),
        "decision, median in s": of("median", "mean", ".3f"),
        "99th percentile in s": of("most", "max", ".3f"),
        "first plan in s": of("first", "mean", ".2f"),
    }
    labels = experiment.axes["seconds"]
    text = table(groups(trials, "seconds", labels), columns, "Planner(seconds=...)")
    return {"times": Table("Decisions of the cart-pole, 100 transitions", text)}
