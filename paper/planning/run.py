"""One run: trials of a cart-pole, each planned in what is known of it by then."""

from __future__ import annotations

import math
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gpadjust.control import (
    CrossEntropy,
    MPCAgent,
    Planner,
    PolicySearch,
    PolicySearchAgent,
    Task,
)
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.envs import (
    CART_POLE_SPEC,
    cart_pole_reward,
    cart_pole_start,
    random_cart_pole_physics,
)
from gpadjust.envs.cart_pole.system import CartPoleEquation, equation_physics
from gpadjust.inference import SamplingWarning
from gpadjust.models import CKA, RRA, PhysicsMeanGP, ZeroMeanGP
from paper.common.experiment import Record
from paper.planning import BOUND, Planning, Settings
from paper.planning.systems import FittedPhysics, environment, equation, mc_pilco_reward

_MODELS: dict[str, Any] = {"cka": CKA, "search": CKA, "phymean": PhysicsMeanGP, "rra": RRA}


def run(experiment: Planning, system: str, learner: str, seed: int, *, unfinished: Path) -> Record:
    """Make the trials; return cost and times of each."""
    warnings.simplefilter("ignore", SamplingWarning)
    warnings.filterwarnings("ignore", message="A step of the last real episode")
    settings = experiment.settings_of(system)
    agent = make_agent(experiment, system, learner, seed)
    rows: list[dict[str, Any]] = []
    for _ in range(settings.trials):
        before, start = dict(agent.wall_time), time.process_time()
        agent.learn(settings.episode_length)
        costs = -agent.recorded_episodes(newest=settings.episode_length).rewards
        late = np.stack(agent.env.episodes[len(rows)])[-round(1 / settings.time_step) :]
        seconds = {name: agent.wall_time[name] - before[name] for name in ("plan", "fit")}
        promised = agent.promised_reward
        rows.append(
            {
                "cost": costs.mean().item(),
                "last_cost": costs[-5:].mean().item(),
                "last_offset": np.abs(late[:, 0]).max().item(),
                "last_lean": np.abs(np.degrees(wrapped(late[:, 1]))).max().item(),
                "promised_cost": math.nan if promised is None else -promised,
                **{f"{name}_seconds": spent for name, spent in seconds.items()},
                "cpu_seconds": time.process_time() - start,
            }
        )
    return {"trials": {name: [row[name] for row in rows] for name in rows[0]}}


def make_agent(
    experiment: Planning, system: str, learner: str, seed: int
) -> MPCAgent | PolicySearchAgent:
    """Who plans, at the start."""
    settings = experiment.settings_of(system)
    env, length = environment(system, settings), settings.episode_length
    each_step, first = planners(settings)
    task = Task(
        dynamics(settings, system, learner, seed),
        mc_pilco_reward if system == "mc-pilco" else cart_pole_reward,
        initial_states=cart_pole_start,
        episode_length=length,
        state_bounds=torch.tensor([[-BOUND] * 4, [BOUND] * 4]) if learner == "search" else None,
    )
    common: dict[str, Any] = {
        "reward_tolerance": None,
        "score_horizons": (),
        "random_steps": settings.random_trials * length,
        "seed": seed,
    }
    if learner != "search":
        return MPCAgent(env, task, each_step, first=first, **common)
    search = PolicySearch(
        updates=settings.updates,
        num_starts=settings.starts,
        num_functions=None,
        learning_rate=settings.learning_rate,
        guide=first,
        num_guides=settings.guides,
    )
    return PolicySearchAgent(env, task, search=search, **common)


def planners(settings: Settings) -> tuple[Planner, Planner]:
    """Who plans at each step, and who plans a trial that begins."""
    elites, correlation = settings.elites, settings.correlation
    each_step = Planner(
        search=CrossEntropy(settings.rounds, num_elites=elites, correlation=correlation),
        horizon=settings.horizon,
        num_random=settings.sequences,
        spread=settings.spread,
    )
    first = Planner(
        search=CrossEntropy(settings.first_rounds, num_elites=elites, correlation=correlation),
        num_random=settings.first_sequences,
        restarts=settings.restarts,
    )
    return each_step, first


def dynamics(settings: Settings, system: str, learner: str, seed: int) -> Dynamics:
    """What is planned in, at its start."""
    time_step = settings.time_step
    if learner == "oracle":
        return PhysicsDynamics(CART_POLE_SPEC, equation_physics(equation(system), time_step))
    physics = random_cart_pole_physics(seed, time_step)
    if learner == "phy":
        return PhysicsDynamics(CART_POLE_SPEC, physics)
    if learner == "fitted":
        known: Any = physics.rhs
        assert isinstance(known, CartPoleEquation), "as it is made"
        return FittedPhysics(known, time_step)
    if learner == "gp":
        return LearnedDynamics(CART_POLE_SPEC, model=ZeroMeanGP)
    return LearnedDynamics(CART_POLE_SPEC, physics, model=_MODELS[learner])


def wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in [-pi, pi)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi
