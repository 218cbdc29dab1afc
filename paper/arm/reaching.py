"""An arm that reaches after a few trials, by gradients through what is known of it."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.noise import NormalActionNoise
from torch import Tensor

from gpadjust.control import BoundedPolicy, PolicySearch, PolicySearchAgent
from gpadjust.core import SamplingWarning
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.physics import as_physics
from gpadjust.states import StateSpec
from gpadjust.systems import System
from paper.arm import BOUNDS, SENSORS, Arm, Reaching
from paper.arm.evaluation import reach, score
from paper.arm.system import arm
from paper.cartpole.planning import trials_table
from paper.common.experiment import Run, Table
from paper.common.learners import LEARNERS
from paper.common.tables import frame

MAPPED = (1, 3)
"""Trials after which the errors at each target are kept."""

_GAINS = {"strength": (16.0, 8.0)}  # the torques that f_p believes in, where not the usual ones
_SD = {
    "theta_s": SENSORS["angles"],
    "theta_e": SENSORS["angles"],
    "theta_s_dot": SENSORS["velocities"],
    "theta_e_dot": SENSORS["velocities"],
}
_SYSTEMS, _LABELS = Reaching.axes["system"], Reaching.axes["learner"]


def run(experiment: Reaching, system: str, learner: str, seed: int) -> Run:
    """Make the trials; return the hand's errors after each, and times."""
    warnings.simplefilter("ignore", SamplingWarning)
    warnings.filterwarnings("ignore", message="A step of the last real episode")
    warnings.filterwarnings("ignore", message=".* of the episodes of the policy left the bounds")
    settings = experiment
    agent = make_agent(experiment, system, learner, seed)
    rows, maps = [], {}
    for trial in range(1, settings.trials + 1):
        if trial > settings.noisy_trials:
            agent.action_noise = None
        before, start = dict(agent.wall_time), time.process_time()
        agent.learn(settings.episode_length)
        spent = time.process_time() - start
        errors = evaluate(agent, system, settings, seed)
        rows.append(
            {
                **{name: float(np.sqrt(np.square(e).mean())) for name, e in errors.items()},
                **{f"{p}_seconds": agent.wall_time[p] - before[p] for p in ("update", "fit")},
                "cpu_seconds": spent,
            }
        )
        if trial in MAPPED:
            maps[f"{trial}"] = errors["all_steps"].round(2).tolist()
    return {"trials": {name: [row[name] for row in rows] for name in rows[0]}, "maps": maps}


def evaluate(agent: Any, system: str, settings: Reaching, seed: int) -> dict[str, Any]:
    """The hand's error at each target, in cm: root mean squares over all and the last steps."""
    arm = Arm(
        strength=settings.strength,
        memory=system == "memory",
        episode_length=settings.episode_length,
    )
    policy = NoisyPolicy(agent, seed) if system == "sensors" else agent
    found: dict[str, Any] = score(reach(policy, arm))
    return found


class NoisyPolicy:
    """A policy that sees the state by noisy sensors.

    Args:
        policy: The policy, with Stable-Baselines3's ``predict``.
        seed: Of the noise.
    """

    def __init__(self, policy: Any, seed: int) -> None:
        self.policy = policy
        self.random = np.random.default_rng(seed)

    def predict(self, observation: NDArray[np.float32], *, deterministic: bool) -> Any:
        """Actions for a batch of observations."""
        seen = observation.astype(np.float64)
        seen[:, :4] += np.array([*_SD.values()]) * self.random.normal(size=seen[:, :4].shape)
        return self.policy.predict(seen.astype(np.float32), deterministic=deterministic)


def make_agent(experiment: Reaching, system: str, learner: str, seed: int) -> PolicySearchAgent:
    """The agent of a run, at its start."""
    settings = experiment
    known = system_of(system, settings)
    task = replace(known.task(dynamics(settings, system, learner)), state_bounds=bounds(known.spec))
    search = PolicySearch(
        updates=settings.updates,
        num_starts=settings.starts,
        num_functions=None,
        learning_rate=settings.learning_rate,
    )
    # Of actions scaled to [-1, 1], as Stable-Baselines3 has it.
    sd = 2 * settings.noise * np.ones(4)
    return PolicySearchAgent(
        known.make(),
        task,
        partial(BoundedPolicy, first_actions=[settings.first_action] * 4),
        search,
        reward_tolerance=None,
        score_horizons=(),
        action_noise=NormalActionNoise(np.zeros(4), sd),
        seed=seed,
    )


def system_of(name: str, settings: Reaching, **options: Any) -> System:
    """An arm, and what is known of it."""
    return arm(
        strength=settings.strength,
        gains=_GAINS.get(name, (8.0, 4.0)),
        memory=name == "memory",
        noise=_SD if name == "sensors" else None,
        substeps=settings.substeps,
        gradient="finite-difference",
        episode_length=settings.episode_length,
        **options,
    )


def bounds(spec: StateSpec) -> Tensor:
    """Those of the states, ``2 x state_dim``; of targets and actions there are none."""
    limits = torch.tensor([[-np.inf], [np.inf]], dtype=torch.float64).repeat(1, spec.state_dim)
    for columns, name in ((slice(0, 2), "angles"), (slice(2, 4), "velocities")):
        limits[:, columns] = torch.tensor(BOUNDS[name]).double().unsqueeze(-1)
    return limits


def dynamics(settings: Reaching, system: str, learner: str) -> Dynamics:
    """The model in which the policy is trained, at its start."""
    arm = system_of(system, settings, unknowns=learner == "fitted")
    spec, physics = arm.spec, as_physics(arm.physics)
    if learner in ("phy", "fitted"):
        return PhysicsDynamics(spec, physics)
    known = LEARNERS[learner]
    return LearnedDynamics(spec, physics if known.adjusts else None, model=known.make)


def tables(runs: Sequence[Run], experiment: Reaching) -> dict[str, Table]:
    """All tables, by name."""
    trials, last, found = frame(_trials(runs), "trials"), experiment.trials, {}
    for system, label in _SYSTEMS.items():
        own = trials[trials["system"] == system]
        shown = [trial for trial in (1, 2, 3, 4, 6, 10) if trial <= own["episode"].max()]
        for measure, steps in (("all_steps", "all steps"), ("last_five", "last five steps")):
            if len(own):
                title = f"The hand's error in cm, {steps}, arm {label}"
                text = trials_table(own, measure, _LABELS, shown, (3, last), (1, last), ".1f")
                found[f"{system}_{measure}"] = Table(title, text)
    return found


def _trials(runs: Sequence[Run]) -> list[Run]:
    return [{name: value for name, value in each.items() if name != "maps"} for each in runs]
