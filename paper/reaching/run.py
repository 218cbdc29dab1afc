"""One run: trials of the arm, each with a policy trained in what is known of it by then."""

from __future__ import annotations

import math
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.noise import NormalActionNoise
from torch import Tensor

from gpadjust.control import PolicySearch, PolicySearchAgent, Task, mlp_policy
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.envs import arm_reward, arm_start
from gpadjust.inference import SamplingWarning
from gpadjust.models import CKA, PhysicsMeanGP, ZeroMeanGP
from gpadjust.states import StateSpec
from paper.arm import Settings as ArmSettings
from paper.arm.system import memory_start, reach, score
from paper.common.experiment import Record
from paper.reaching import BOUNDS, Reaching, Settings
from paper.reaching.ensemble import ResidualEnsemble
from paper.reaching.systems import (
    FittedArm,
    NoisyPolicy,
    as_physics,
    believed,
    environment,
    spec_of,
)

MAPPED = (1, 3, 9)
"""Trials after which the errors at each target are kept."""

_MODELS: dict[str, Any] = {"cka": CKA, "phymean": PhysicsMeanGP, "gp": ZeroMeanGP}


def run(experiment: Reaching, system: str, learner: str, seed: int, *, unfinished: Path) -> Record:
    """Make the trials; return the hand's errors after each, and times."""
    warnings.simplefilter("ignore", SamplingWarning)
    warnings.filterwarnings("ignore", message="A step of the last real episode")
    warnings.filterwarnings("ignore", message=".* of the episodes of the policy left the bounds")
    settings, trials = experiment.settings, experiment.trials(system, learner)
    agent = make_agent(experiment, system, learner, seed)
    rows, maps = [], {}
    for trial in range(1, trials + 1):
        if trial > settings.noisy_trials:
            agent.action_noise = None
        before, start = dict(agent.wall_time), time.process_time()
        agent.learn(settings.episode_length)
        spent = time.process_time() - start
        errors = evaluate(agent, system, settings, seed)
        promised = agent.promised_reward
        rows.append(
            {
                **{name: float(np.sqrt(np.square(e).mean())) for name, e in errors.items()},
                "promised_cost": math.nan if promised is None else -promised,
                **{f"{p}_seconds": agent.wall_time[p] - before[p] for p in ("update", "fit")},
                "cpu_seconds": spent,
            }
        )
        if trial in MAPPED:
            maps[f"{trial}"] = errors["all_steps"].tolist()
    return {"trials": {name: [row[name] for row in rows] for name in rows[0]}, "maps": maps}


def evaluate(agent: Any, system: str, settings: Settings, seed: int) -> dict[str, Any]:
    """The hand's error at each target, in cm: root mean squares over all and the last steps."""
    arm = ArmSettings(
        strength=settings.strength,
        memory=system == "memory",
        episode_length=settings.episode_length,
    )
    policy = NoisyPolicy(agent, seed) if system == "sensors" else agent
    found: dict[str, Any] = score(reach(policy, arm))
    return found


def make_agent(experiment: Reaching, system: str, learner: str, seed: int) -> PolicySearchAgent:
    """Who learns, at the start."""
    settings = experiment.settings
    task = Task(
        dynamics(settings, system, learner),
        arm_reward,
        initial_states=memory_start if system == "memory" else arm_start,
        episode_length=settings.episode_length,
        state_bounds=bounds(spec_of(system)),
    )
    search = PolicySearch(
        updates=settings.updates,
        num_starts=settings.starts,
        num_functions=None,
        learning_rate=settings.learning_rate,
    )
    # Of actions scaled to [-1, 1], as SB3 has it.
    sd = 2 * settings.noise * np.ones(4)
    return PolicySearchAgent(
        environment(system, settings),
        task,
        partial(mlp_policy, first_actions=[settings.first_action] * 4),
        search,
        reward_tolerance=None,
        score_horizons=(),
        action_noise=NormalActionNoise(np.zeros(4), sd),
        seed=seed,
    )


def bounds(spec: StateSpec) -> Tensor:
    """Those of the states, ``2 x state_dim``; of targets and actions there are none."""
    limits = torch.tensor([[-np.inf], [np.inf]], dtype=torch.float64).repeat(1, spec.state_dim)
    for columns, name in ((slice(0, 2), "angles"), (slice(2, 4), "velocities")):
        limits[:, columns] = torch.tensor(BOUNDS[name]).double().unsqueeze(-1)
    return limits


def dynamics(settings: Settings, system: str, learner: str) -> Dynamics:
    """What the policy is trained in, at its start."""
    spec, equation = spec_of(system), believed(system)
    if learner == "fitted":
        return FittedArm(spec, equation, settings)
    physics = as_physics(equation, settings)
    if learner == "phy":
        return PhysicsDynamics(spec, physics)
    if learner == "ensemble":
        return ResidualEnsemble(spec, physics)
    return LearnedDynamics(
        spec,
        None if learner == "gp" else physics,
        model=_MODELS[learner],
    )
