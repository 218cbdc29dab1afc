"""The cart-pole that follows its force a step late: told or not, and found or not."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from gpadjust.control import MPCAgent
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.dynamics.learning import DynamicsFitOptions
from gpadjust.states import StateSpec
from gpadjust.systems import RememberAction, System, cart_pole
from gpadjust.systems.swing_up import CART_POLE_SPEC
from paper.common.experiment import Run, Table
from paper.common.figures import panels, save
from paper.common.tables import frame, groups, of, table
from paper.control import Delays
from paper.control.planners import planners

_HINT = "hint_"
_NOISE = {"x": 0.01, "theta": 0.02, "x_dot": 0.05, "theta_dot": 0.1}
LATE = StateSpec(
    [*CART_POLE_SPEC.states, "force_1"],
    CART_POLE_SPEC.actions,
    angles=CART_POLE_SPEC.angles,
    previous={"force_1": CART_POLE_SPEC.actions[0]},
    step=CART_POLE_SPEC.step,
)
"""The states of a cart-pole, and the force of one step before."""


class Late(gym.Wrapper[Any, Any, Any, Any]):
    """An environment that takes each action a step late, and zero at first."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        shape = self.action_space.shape
        self.waiting = deque([np.zeros(shape or (), dtype=np.float32)])
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """Take the action of one step before."""
        self.waiting.append(action)
        return self.env.step(self.waiting.popleft())


def run(experiment: Delays, told: str, seed: int) -> Run:
    """Make the trials; return their costs, and after which of them the delay was told."""
    settings, asks = experiment.settings, told.startswith(_HINT)
    agent, length = _agent(experiment, told, seed)
    costs, states, found_after = [], [], None
    for trial in range(1, (settings.hint_trials if asks else settings.trials) + 1):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            agent.learn(length)
        episode = agent.recorded_episodes(newest=length)
        costs.append(-episode.rewards.mean().item())
        states.append(episode.next_states[:, 1].tolist())
        if any("The data follow" in str(each.message) for each in caught):
            found_after = found_after or trial
    return {"trials": {"cost": costs, "lean": states}, "found_after": found_after}


def _agent(experiment: Delays, told: str, seed: int) -> tuple[MPCAgent, int]:
    settings, asks = experiment.settings, told.startswith(_HINT)
    system = cart_pole(
        seed,
        dry=settings.dry if told in ("hint_dry", "hint_noisy") else 0.0,
        noise=_NOISE if told == "hint_noisy" else None,
    )
    env = system.make()
    if told in ("not", "previous", "physics", "hint_late"):
        env = Late(env)
    if told in ("previous", "physics"):
        env, system = RememberAction(env), _remembering(system, told == "physics")
    if asks:
        settings = replace(
            settings,
            sequences=settings.hint_sequences,
            first_sequences=settings.hint_sequences,
            first_rounds=settings.hint_rounds,
        )
    plans = planners(settings, settings.horizon * (system.spec.step or 1.0))
    dynamics: Dynamics = PhysicsDynamics(system.spec, system.physics)
    if not asks:
        likely: DynamicsFitOptions = {"method": settings.fit}
        dynamics = LearnedDynamics(system.spec, system.physics, fit_options=likely)
    how: dict[str, Any] = {"reward_tolerance": None, "score_horizons": (), "seed": seed}
    agent = MPCAgent(env, system.task(dynamics), **plans, **how)
    return agent, system.episode_length or 0


def _remembering(system: System, physics_is_told: bool) -> System:
    """The system whose state holds the force of one step before; f_p may read it."""
    reads = (*CART_POLE_SPEC.states, "force_1") if physics_is_told else ()
    return replace(
        system,
        spec=replace(LATE, physics_reads=reads),
        start=None,
        reward=lambda states, actions, following: system.reward(
            states[:, :4], actions, following[:, :4]
        ),
    )


def tables(runs: Sequence[Run], experiment: Delays) -> dict[str, Table]:
    """All tables, by name."""
    labels, trials = experiment.axes["told"], frame(runs, "trials", "trial")
    asked = trials["told"].str.startswith(_HINT)
    columns = {"runs": of("seed", "nunique", ".0f")}
    for trial in range(1, experiment.settings.trials + 1):
        columns[f"cost of trial {trial}"] = _in_trial(trial)
    rows = groups(trials[~asked], "told", labels)
    found = {
        "costs": Table(
            "Cart-pole that follows its force a step late", table(rows, columns, "delay")
        )
    }
    every = frame(runs)
    said = {"runs": of("seed", "nunique", ".0f")}
    for trial in range(1, experiment.settings.hint_trials + 1):
        said[f"said by trial {trial}"] = of("found_after", _by(trial), ".0f")
    rows = groups(every[every["told"].str.startswith(_HINT)], "told", labels)
    found["found"] = Table("A delay that was not told", table(rows, said, "system"))
    return found


def _by(trial: int) -> Callable[[Any], float]:
    """Number of runs in which it was found by then."""
    return lambda found: float((found <= trial).sum())


def _in_trial(trial: int) -> Any:
    cell = of("cost", "mean", ".3f")
    return lambda runs: cell(runs[runs["trial"] == trial])


def draw(runs: Sequence[Run], experiment: Delays) -> list[Path]:
    """The cost of each trial, run by run."""
    figure, axes = panels(["A cart-pole that follows its force a step late"], 1, (5.5, 3.0))
    colors = {"not": "tab:red", "previous": "tab:orange", "physics": "navy", "none": "0.6"}
    for told, color in colors.items():
        own = [run["trials"]["cost"] for run in runs if run["told"] == told]
        if own:
            trials = np.arange(1, len(own[0]) + 1)
            axes[0].plot(trials, np.mean(own, 0), color=color, label=experiment.axes["told"][told])
            axes[0].plot(trials, np.transpose(own), color=color, linewidth=0.6, alpha=0.4)
    axes[0].set(xlabel="trial", ylabel="mean cost of a step", ylim=(0, 1))
    axes[0].set_xticks(np.arange(1, experiment.settings.trials + 1))
    axes[0].legend(frameon=False, fontsize=8)
    return [save(figure, experiment.out / "delays.png")]
