"""One run: trials of a cart-pole, each planned in what is known of it by then."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any

from gpadjust.control import CrossEntropy, Planner, Task
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.envs import CART_POLE_SPEC, cart_pole_reward, random_cart_pole_physics
from gpadjust.envs.cart_pole.system import CartPoleEquation, equation_physics
from gpadjust.inference import SamplingWarning
from gpadjust.models import CKA, RRA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.rl import ModelOptions, MPCAgent
from paper.common.experiment import Record
from paper.planning import Planning, Settings
from paper.planning.systems import FittedPhysics, environment, equation

_MODELS: dict[str, Any] = {"cka": CKA, "phymean": PhysicsMeanGP, "rra": RRA}


def run(experiment: Planning, system: str, learner: str, seed: int, *, unfinished: Path) -> Record:
    """Make the trials; return cost and times of each."""
    warnings.simplefilter("ignore", SamplingWarning)
    warnings.filterwarnings("ignore", message="A step of the last real episode")
    settings, agent = experiment.settings, make_agent(experiment, system, learner, seed)
    rows: list[dict[str, Any]] = []
    for _ in range(settings.trials):
        before, start = dict(agent.wall_time), time.process_time()
        agent.learn(settings.episode_length, reset_num_timesteps=False)
        costs = -agent.recorded_episodes(newest=settings.episode_length).rewards
        seconds = {name: agent.wall_time[name] - before[name] for name in ("plan", "fit")}
        rows.append(
            {
                "cost": costs.mean().item(),
                "last_cost": costs[-5:].mean().item(),
                "promised_cost": -(agent.promised_reward or float("nan")),
                **{f"{name}_seconds": spent for name, spent in seconds.items()},
                "cpu_seconds": time.process_time() - start,
            }
        )
    return {"trials": {name: [row[name] for row in rows] for name in rows[0]}}


def make_agent(experiment: Planning, system: str, learner: str, seed: int) -> MPCAgent:
    """Who plans, at the start."""
    settings = experiment.settings
    task = Task(
        dynamics(system, learner, seed), cart_pole_reward, episode_length=settings.episode_length
    )
    each_step, first = planners(settings)
    return MPCAgent(
        environment(system, settings.episode_length),
        task,
        each_step,
        first=first,
        options=ModelOptions(reward_tolerance=None, score_horizons=()),
        seed=seed,
        device="cpu",
    )


def planners(settings: Settings) -> tuple[Planner, Planner]:
    """Who plans at each step, and who plans a trial that begins."""
    elites, correlation = settings.elites, settings.correlation
    each_step = Planner(
        search=CrossEntropy(settings.rounds, num_elites=elites, correlation=correlation),
        horizon=settings.horizon,
        num_random=settings.sequences,
        num_policy=0,
        spread=settings.spread,
    )
    first = Planner(
        search=CrossEntropy(settings.first_rounds, num_elites=elites, correlation=correlation),
        num_random=settings.first_sequences,
        num_policy=0,
        restarts=settings.restarts,
    )
    return each_step, first


def dynamics(system: str, learner: str, seed: int) -> Dynamics:
    """What is planned in, at its start."""
    if learner == "oracle":
        return PhysicsDynamics(CART_POLE_SPEC, equation_physics(equation(system)))
    physics = random_cart_pole_physics(seed)
    if learner == "phy":
        return PhysicsDynamics(CART_POLE_SPEC, physics)
    if learner == "fitted":
        known: Any = physics.rhs
        assert isinstance(known, CartPoleEquation), "as it is made"
        return FittedPhysics(known)
    if learner == "gp":
        return LearnedDynamics(CART_POLE_SPEC, model=ZeroMeanGP)
    return LearnedDynamics(CART_POLE_SPEC, physics, model=_MODELS[learner])
