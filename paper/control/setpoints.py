"""Two tanks whose set-point moves from trial to trial, or within a trial."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from gpadjust.control import MPCAgent
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.dynamics.learning import DynamicsFitOptions
from gpadjust.systems import System
from paper.common.experiment import Run, Table
from paper.common.tables import frame, groups, of, table
from paper.control import Setpoints
from paper.control.planners import planners
from paper.control.systems import tanks

_SET_POINTS = (2.0, 6.0)  # in cm, of the first trial and of later ones
_WIDE = 1000.0
_MIDDLE, _AMPLITUDE, _PERIOD = 4.0, 1.5, 14  # of the sine, in cm and steps


def sine(states: Tensor, steps: Tensor) -> Tensor:
    """The set-point after so many steps."""
    wave = torch.sin(2 * math.pi * steps.double() / _PERIOD)
    return (_MIDDLE + _AMPLITUDE * wave).unsqueeze(-1)


def stays(states: Tensor, steps: Tensor) -> Tensor:
    """The set-point as it was."""
    return states[:, 2:]


class Moving(gym.Wrapper[Any, Any, Any, Any]):
    """The tanks with levels of about 1.5 cm at first, and a set-point that moves.

    Args:
        env: The tanks.
        within: Whether it is the sine; else it is another one from the second trial on.
    """

    def __init__(self, env: gym.Env[Any, Any], within: bool) -> None:
        super().__init__(env)
        self.within, self.trials, self.steps = within, 0, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin a trial."""
        self.env.reset(seed=seed)
        levels = self.unwrapped.np_random.uniform(1.2, 1.8, 2)
        goal = _MIDDLE if self.within else _SET_POINTS[min(self.trials, 1)]
        self.trials, self.steps = self.trials + 1, 0
        return self.env.reset(options={"state": [*levels, goal]})

    def step(self, action: Any) -> Any:
        """Make a step, and move the set-point if it is the sine."""
        self.steps += 1
        unwrapped: Any = self.unwrapped
        before = unwrapped.state.clone()
        observation, reward, *rest = self.env.step(action)
        if self.within:
            state = unwrapped.state.clone()
            state[2] = sine(state[None], torch.tensor([self.steps]))[0, 0]
            unwrapped.state, observation = state, state.numpy()
            row = torch.as_tensor(np.asarray(action, dtype=float))[None]
            reward = float(unwrapped.machine.reward(before[None], row, state[None]))
        return (observation, reward, *rest)


def run(experiment: Setpoints, moves: str, plans: str, seed: int) -> Run:
    """Make the trials; return the cost of each, and of its last third."""
    warnings.filterwarnings("ignore", message="A step of the last|The best plan|An episode came")
    agent, system = _agent(experiment, moves, plans, seed)
    length = system.episode_length or 0
    costs, late = [], []
    for _ in range(experiment.settings.trials):
        agent.learn(length)
        found = -agent.recorded_episodes(newest=length).rewards
        costs.append(found.mean().item())
        late.append(found[-(length // 3) :].mean().item())
        if plans == "seen":  # the earlier default
            bounds = agent.recorded_episodes().bounds()
            agent.task = replace(agent.task, state_bounds=bounds)
    return {"trials": {"cost": costs, "late_cost": late}}


def _agent(experiment: Setpoints, moves: str, plans: str, seed: int) -> tuple[MPCAgent, System]:
    system, settings = tanks("true" if plans == "oracle" else "crude"), experiment.settings
    far = torch.tensor([[-_WIDE] * 3, [_WIDE] * 3], dtype=torch.float64)
    given = plans in ("wide", "oracle")
    system = replace(system, start=None, state_bounds=far if given else None)
    if moves == "within":
        system = replace(system, reference=stays if plans == "constant" else sine)
    dynamics: Dynamics = PhysicsDynamics(system.spec, system.physics)
    if plans != "oracle":
        likely: DynamicsFitOptions = {"method": settings.fit}
        dynamics = LearnedDynamics(system.spec, system.physics, fit_options=likely)
    by = planners(settings, settings.horizon * (system.spec.step or 1.0))
    env = Moving(system.make(), moves == "within")
    # Nothing is checked, as the reference that is believed to stay is not the environment's.
    how: dict[str, Any] = {"reward_tolerance": None, "score_horizons": (), "seed": seed}
    return MPCAgent(env, system.task(dynamics), **by, **how), system


def tables(runs: Sequence[Run], experiment: Setpoints) -> dict[str, Table]:
    """All tables, by name."""
    trials, found = frame(runs, "trials", "trial"), {}
    last = experiment.settings.trials
    for moves, title in (
        ("between", "Set-point of 2 cm in trial 1, of 6 cm from then on"),
        ("within", "Set-point that is a sine of 14 steps"),
    ):
        kinds = experiment.axes["moves", "plans"].items()
        labels = {plans: label for (kind, plans), label in kinds if kind == moves}
        own = trials[trials["moves"] == moves]
        columns = {"runs": of("seed", "nunique", ".0f")}
        for trial in range(1, last + 1):
            columns |= {
                f"cost of trial {trial}": _in_trial(trial, "cost", "mean"),
                f"worst run, trial {trial}": _in_trial(trial, "cost", "max"),
                f"last third, trial {trial}": _in_trial(trial, "late_cost", "mean"),
            }
        found[moves] = Table(title, table(groups(own, "plans", labels), columns, "plans"))
    return found


def _in_trial(trial: int, column: str, how: str) -> Any:
    cell = of(column, how, ".3f")
    return lambda runs: cell(runs[runs["trial"] == trial])
