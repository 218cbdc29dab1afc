"""An agent's trials, and how well dynamics that learn them one by one foresee the next."""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gpadjust import CKA
from gpadjust.dynamics import LearnedDynamics, Trajectories
from gpadjust.inference import SamplingWarning
from gpadjust.states import StateSpec
from paper.common.experiment import Record
from paper.control.learner import make_agent
from paper.foresight import LEARNER, METHODS, NOISES, SENSORS, Foresight, Settings


def run(experiment: Foresight, system: str, seed: int, *, unfinished: Path) -> Record:
    """Let an agent make trials; return the scores of each method with each noise."""
    warnings.simplefilter("ignore", SamplingWarning)
    control = experiment.control(system)
    agent = make_agent(control, LEARNER, seed)
    known: Any = agent.ready_task().dynamics  # of the control experiment: at the most likely
    spec, physics = known.spec, known.physics
    agent.task = replace(agent.ready_task(), dynamics=_dynamics(spec, physics, "default"))
    length = control.settings.episode_length
    agent.gradient_steps = length
    start = time.process_time()
    agent.learn(experiment.settings.trials * length, log_interval=experiment.settings.trials + 1)
    seconds = time.process_time() - start
    made = agent.recorded_episodes()
    columns = (t.split(length) for t in (made.states, made.actions, made.next_states))
    trials = [Trajectories(*rows, torch.zeros(length)) for rows in zip(*columns, strict=True)]
    rewards = [each.mean().item() for each in made.rewards.split(length)]
    found: dict[str, Any] = {"agent_seconds": seconds, "rewards": rewards}
    for noise in NOISES:
        seen = trials if noise == "none" else measured(spec, trials, seed)
        for method in METHODS:
            dynamics = _dynamics(spec, physics, method)
            found[f"{noise}-{method}"] = _replay(dynamics, seen, experiment.settings)
    return found


def measured(spec: StateSpec, trials: list[Trajectories], seed: int) -> list[Trajectories]:
    """The same trials as noisy sensors see them: each state once, whichever row it is in."""
    sd = torch.tensor([SENSORS.get(name, 0.0) for name in spec.states], dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed + 1_000)
    found = []
    for states, actions, next_states in trials:
        all_states = torch.cat([states, next_states[-1:]])
        noise = sd * torch.randn(all_states.shape, generator=generator, dtype=torch.float64)
        seen = all_states + noise
        found.append(Trajectories(seen[:-1], actions, seen[1:], torch.zeros(len(actions))))
    return found


def _dynamics(spec: StateSpec, physics: Any, method: str) -> LearnedDynamics:
    if method == "default":
        return LearnedDynamics(spec, physics)
    return LearnedDynamics(
        spec, physics, model=partial(CKA, center=0.0), fit_options={"method": "map"}
    )


def _replay(
    dynamics: LearnedDynamics, trials: list[Trajectories], settings: Settings
) -> dict[str, Any]:
    """Learn all trials but the last, one by one, each time judged by the next."""
    rows, third = [], max(1, (len(trials) - 1) // 3)
    conditioned: dict[str, Any] = {}
    for i, (learnt, unseen) in enumerate(pairwise(trials), 1):
        start = time.process_time()
        dynamics.update(*learnt)
        seconds = time.process_time() - start
        rows.append({**_scores(dynamics, unseen, settings), "fit_seconds": seconds})
        if i == third:
            last, state = trials[-1], dynamics.state_dict()
            further = [torch.cat(columns) for columns in zip(*trials[third:-1], strict=True)]
            dynamics.condition(*further)
            conditioned = _scores(dynamics, last, settings)
            dynamics.load_state_dict(state)
    found = {name: [row[name] for row in rows] for name in rows[0]}
    return {**found, "conditioned": conditioned}


def _scores(dynamics: LearnedDynamics, unseen: Trajectories, settings: Settings) -> dict[str, Any]:
    """Of the next states, and of trajectories by their number of steps; an entry for each state."""
    near = dynamics.score(*unseen)
    found: dict[str, Any] = {"coverage": _list(near.coverage), "nlpd": _list(near.nlpd)}
    moving = dynamics.spec.moving
    for steps in settings.horizons:
        windows = unseen.windows(steps, stride=1)
        last = len(windows.actions) - 1
        number = min(last + 1, settings.max_windows)
        windows = windows.some(torch.linspace(0, last, number).round().long())
        run = dynamics.free_run(
            windows.initial_states, windows.actions, num_functions=settings.num_functions
        )
        far = run.score(windows.measured, horizons=[steps])
        found[f"coverage_{steps}"] = _list(far.coverage[0, moving])
        found[f"nlpd_{steps}"] = _list(far.nlpd[0, moving])
    return found


def _list(values: Tensor) -> list[float]:
    found: list[float] = values.tolist()
    return found
