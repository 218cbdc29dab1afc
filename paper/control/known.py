"""Trials of systems that people know, each planned in what is known of them by then."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import pandas as pd

from gpadjust.control import MPCAgent, Planner
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.physics import as_physics
from gpadjust.systems import System
from paper.common.experiment import Run, Table
from paper.common.learners import LEARNERS
from paper.common.tables import frame, groups, markdown, number
from paper.common.verdicts import Curves, Difference, paired
from paper.control import HORIZONS, Known
from paper.control.machine import Physics
from paper.control.systems import MACHINES
from paper.machines.networks import NetworkDynamics

_SYSTEMS, _LEARNERS = Known.axes["system"], Known.axes["learner"]
_PHYSICS: dict[str, Physics] = {"oracle": "true", "fitted": "unknown"}  # else the crude one
_RATIOS = ("phymean", "fitted", "gp", "ensemble")  # to which CKA is compared


def run(experiment: Known, system: str, learner: str, seed: int) -> Run:
    """Make the trials; return the cost of each."""
    agent, known = make_agent(experiment, system, learner, seed)
    length = known.episode_length or 0
    costs = []
    for _ in range(experiment.trials):
        agent.learn(length)
        costs.append(-agent.recorded_episodes(newest=length).rewards.mean().item())
    return {"trials": {"cost": costs}}


def make_agent(settings: Known, system: str, learner: str, seed: int) -> tuple[MPCAgent, System]:
    """Return the agent of a run, at its start, and the system that it controls."""
    known = MACHINES[system].system(_PHYSICS.get(learner, "crude"))
    task = known.task(dynamics(settings, known, learner))
    planner = partial(Planner, num_elites=settings.elites, correlation=0.5)
    each_step = planner(
        rounds=settings.rounds,
        horizon=HORIZONS[system] * (known.spec.step or 1.0),
        num_random=settings.sequences,
        spread=settings.spread,
    )
    first = planner(rounds=settings.first_rounds, num_random=settings.first_sequences)
    options: dict[str, Any] = {"score_horizons": (), "seed": seed}
    return MPCAgent(known.make(), task, each_step, first=first, **options), known


def dynamics(settings: Known, known: System, learner: str) -> Dynamics:
    """Return the model in which plans are made, at its start."""
    physics = as_physics(known.physics)
    if learner in ("phy", "fitted", "oracle"):
        return PhysicsDynamics(known.spec, physics)
    if learner == "ensemble":
        number, steps = settings.networks, settings.training
        return NetworkDynamics(known.spec, physics, number=number, steps=steps)
    made = LEARNERS[learner]
    given = physics if made.adjusts else None
    fit_options = {"method": settings.fit}
    return LearnedDynamics(known.spec, given, model=made.make, fit_options=fit_options)


def tables(runs: Sequence[Run], experiment: Known) -> dict[str, Table]:
    """Return all tables, by name."""
    trials = frame(runs, "trials")
    by_system = groups(trials, "system", _SYSTEMS)
    curves = [Curves(own, "cost") for own in by_system.values()]
    rows = [
        [label, *(_costs(own, learner) for own in curves), ""]
        for learner, label in _LEARNERS.items()
    ]
    late = trials[trials["episode"] > 1].groupby([*Known.key], sort=False)["cost"].mean()
    later = late.reset_index()
    parts = groups(later, "system", _SYSTEMS).values()
    for other in _RATIOS:
        cells = [number(math.exp(_ratio(part, other).mean), ".2f") for part in parts]
        label = f"CKA / {_LEARNERS[other]}, trials 2 and 3"
        rows.append([label, *cells, _ratio(later, other).ratio(".2f")])
    heads = [f"{name} ({own['seed'].nunique()} runs)" for name, own in by_system.items()]
    rows = [row for row in rows if any(row[1:])]
    text = markdown(["mean cost of trials 1; 2; 3", *heads, "all systems"], rows)
    return {"costs": Table("Costs of trials, and their ratios", text)}


def _ratio(later: pd.DataFrame, other: str) -> Difference:
    """Return the ratio of CKA's cost to another's in the later trials, pair by pair."""
    return paired(later, "cost", "learner", "cka", other, ("system", "seed"), ratio=True)


def _costs(curves: Curves, learner: str) -> str:
    """Return the mean cost of each trial, with the standard error over the later ones."""
    if learner not in curves.names:
        return ""
    means = "; ".join(number(mean, ".2f") for mean in curves.mean(learner))
    error = number(curves.window(learner, 2, 3).sem(), ".2f")
    runs = len(curves.seeds(learner))
    few = f", {runs} runs" if runs < curves.runs["seed"].nunique() else ""
    return f"{means} (± {error}{few})" if error else means
