"""Trials of systems whose rates are hidden, each planned in what is known by then."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.control import Estimate, MPCAgent
from gpadjust.dynamics import LearnedDynamics
from gpadjust.dynamics.learning import DynamicsFitOptions
from gpadjust.inference import ParameterWarning, SamplingWarning
from gpadjust.states import Sensors, StateSpec
from gpadjust.systems import System, cart_pole
from paper.common.experiment import Run, Table
from paper.common.figures import save
from paper.common.tables import frame, groups, markdown, number
from paper.common.verdicts import Curves, paired
from paper.control import HORIZONS, Hidden, HiddenSettings
from paper.control.planners import planners
from paper.control.systems import furuta

_SYSTEMS, _LEARNERS = Hidden.axes["system"], Hidden.axes["learner"]
_MEASURED = {"cart_pole": ["x", "theta"], "furuta": ["arm", "theta"]}
_STEP = {"cart_pole": 0.1, "furuta": 0.04}  # s
_TOLD = 2  # the trial whose states are kept, for the picture


class Starts(gym.Wrapper[Any, Any, Any, Any]):
    """Episodes that start, and are disturbed, as those of every other learner."""

    def __init__(self, env: gym.Env[Any, Any], seed: int) -> None:
        super().__init__(env)
        self.next_seed = 1000 * seed

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin the next episode."""
        self.next_seed += 1
        return self.env.reset(seed=self.next_seed, options=options)


class Quotients(gym.Wrapper[Any, Any, Any, Any]):
    """States whose last half is the difference quotients of the first; zeros at the start.

    Args:
        env: An environment that observes the first half.
        seen: The spec of what it observes.
        spec: That of the states.
        step: The time step.
    """

    def __init__(
        self, env: gym.Env[Any, Any], seen: StateSpec, spec: StateSpec, step: float
    ) -> None:
        super().__init__(env)
        self.seen, self.state_spec, self.time_step = seen, spec, step
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (spec.observation_dim,))
        self.before = torch.zeros(0)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.before = self._values(observation)
        return self._states(self.before), info

    def step(self, action: Any) -> Any:
        """Make a step."""
        observation, *rest = self.env.step(action)
        values = self._values(observation)
        found = self._states(values)
        self.before = values
        return found, *rest

    def _values(self, observation: NDArray[Any]) -> Tensor:
        return self.seen.decode(torch.from_numpy(np.asarray(observation, dtype=float)))

    def _states(self, values: Tensor) -> NDArray[np.float32]:
        rates = self.seen.change(self.before, values) / self.time_step
        return self.state_spec.observe(torch.cat([values, rates])).numpy().astype(np.float32)


class Watching(MPCAgent):
    """Remembers where it believes the system to be, and where it is.

    Attributes:
        notes: ``"watched"``, for each step the true state, the estimate and its standard
            deviations, and ``"seen"``, what was observed, with angles in rad.
    """

    def predict(self, observation: Any, state: Any = None, *args: Any, **options: Any) -> Any:
        """Plan an action, and remember."""
        action, state = super().predict(observation, state, *args, **options)
        known, spec = state[0].estimate, self.task.dynamics.spec
        seen = self.task.observed.decode(torch.from_numpy(np.asarray(observation, dtype=float)))
        if known is None:
            known = Estimate(seen, torch.zeros(len(seen), len(seen)))
        unwrapped: Any = self.env.unwrapped
        true = torch.as_tensor(np.asarray(unwrapped.state), dtype=torch.float64)
        row = true, true + spec.change(true, known.mean), known.covariance.diagonal().sqrt()
        self.notes.setdefault("watched", []).append(torch.stack(row))
        self.notes.setdefault("seen", []).append(seen)
        return action, state


def run(experiment: Hidden, system: str, learner: str, seed: int) -> Run:
    """Make the trials; return cost, errors and coverage of each, and the states of one."""
    for category in (SamplingWarning, ParameterWarning):
        warnings.simplefilter("ignore", category)
    warnings.filterwarnings("ignore", message="A step of the last real episode")
    agent, known = make_agent(experiment.settings, system, learner, seed)
    length = known.episode_length or 0
    rows: list[dict[str, Any]] = []
    for _ in range(experiment.settings.trials):
        start = time.process_time()
        agent.learn(length)
        costs = -agent.recorded_episodes(newest=length).rewards
        true, mean, sd = torch.stack(agent.notes["watched"][-length:]).unbind(1)
        off = (mean - true)[:, 2:]
        row = {"cost": costs.mean().item(), "error": off.square().mean(0).sqrt().tolist()}
        if agent.filter is not None:
            held = off.abs() <= 1.96 * sd[:, 2:]
            row |= {"coverage": held.double().mean().item(), "noise": agent.filter.noise.tolist()}
        rows.append({**row, "cpu_seconds": time.process_time() - start})
    told = slice(length * (_TOLD - 1), length * _TOLD)
    watched = torch.stack(agent.notes["watched"][told]).unbind(1)
    states = dict(zip(("true", "mean", "sd"), watched, strict=True))
    states["seen"] = torch.stack(agent.notes["seen"][told])
    return {
        "trials": {name: [row[name] for row in rows] for name in rows[0]},
        "states": {name: part.tolist() for name, part in states.items()},
    }


def make_agent(
    settings: HiddenSettings, system: str, learner: str, seed: int
) -> tuple[Watching, System]:
    """The agent of a run, at its start, and what it controls."""
    known = cart_pole(seed) if system == "cart_pole" else furuta()
    sensors = Sensors(_MEASURED[system])
    if learner != "full":
        noise = dict.fromkeys(sensors.outputs, settings.noise)
        known = replace(known, sensors=sensors, noise=noise)
    env: gym.Env[Any, Any] = Starts(known.make(), seed)
    fit: DynamicsFitOptions = {"method": settings.fit}
    task = known.task(LearnedDynamics(known.spec, known.physics, fit_options=fit))
    if learner == "quotient":
        env = Quotients(env, sensors.spec(known.spec), known.spec, _STEP[system])
        task = replace(task, sensors=None)
    plans = planners(settings, HORIZONS[system] * _STEP[system])
    options: dict[str, Any] = {"score_horizons": (), "reward_tolerance": None, "seed": seed}
    return Watching(env, task, **plans, **options), known


def tables(runs: Sequence[Run], experiment: Hidden) -> dict[str, Table]:
    """All tables, by name."""
    trials, last = frame(runs, "trials"), experiment.settings.trials
    rows = []
    for system, own in groups(trials, "system", _SYSTEMS).items():
        curves, late = Curves(own, "cost"), own[own["episode"] > 1]
        means = late.groupby(["learner", "seed"], sort=False)["cost"].mean().reset_index()
        for learner, label in _LEARNERS.items():
            if learner not in curves.names:
                continue
            part = late[late["learner"] == learner]
            errors = np.sqrt(np.mean(np.square(np.stack(part["error"])), axis=0))
            gap = paired(means, "cost", "learner", learner, "full", ratio=True)
            cells = [
                f"{system}: {label} ({part['seed'].nunique()} runs)",
                "; ".join(number(curves.mean_at(learner, t), ".2f") for t in range(1, last + 1)),
                number(curves.window(learner, 2, last).mean(), ".3f"),
                "" if learner == "full" else gap.ratio(".2f"),
                "" if learner == "full" else "; ".join(number(e, ".2f") for e in errors),
            ]
            if learner == "filter":
                noise = np.stack(part[part["episode"] == last]["noise"]).mean(0)
                cells += [number(part["coverage"].mean(), ".0%"),
                          "; ".join(number(sd, ".4f") for sd in noise)]  # fmt: skip
            rows.append(cells + [""] * (7 - len(cells)))
    heads = [
        "measured",
        "cost of each trial",
        f"of trials 2 to {last}",
        "ratio to all states",
        "error of the rates, rad/s or m/s",
        "95 % intervals hold",
        "noise found (true: 0.01)",
    ]
    return {"costs": Table("Costs and estimates where rates are hidden", markdown(heads, rows))}


def draw(runs: Sequence[Run], experiment: Hidden) -> list[Path]:
    """Draw a rate in the second trial of the first seed: true, estimated, by quotients."""
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    own = [r for r in runs if r["seed"] == experiment.seed]
    names = [name for name in _SYSTEMS if any(r["system"] == name for r in own)]
    panels = figure.subplots(1, len(names), squeeze=False)[0]
    for ax, name in zip(panels, names, strict=True):
        told = {r["learner"]: r["states"] for r in own if r["system"] == name}
        if "filter" in told:
            true, mean, sd = (np.array(told["filter"][k])[:, 3] for k in ("true", "mean", "sd"))
            t = _STEP[str(name)] * np.arange(len(true))
            ax.fill_between(t, mean - 1.96 * sd, mean + 1.96 * sd, color="tab:blue", alpha=0.25,
                            label="95 % interval", lw=0)  # fmt: skip
            ax.plot(t, mean, color="tab:blue", label="estimate")
            steps = np.diff(np.array(told["filter"]["seen"])[:, 1])
            steps = (steps + np.pi) % (2 * np.pi) - np.pi
            ax.plot(t[1:], steps / _STEP[str(name)], "o", ms=3, color="tab:orange",
                    label="difference quotient")  # fmt: skip
            ax.plot(t, true, "k--", lw=1, label="true")
        ax.set_title(_SYSTEMS[str(name)], loc="left", fontsize=10)
        ax.set_xlabel("time, s")
        ax.set_ylabel("rate of the pendulum, rad/s")
        ax.spines[["top", "right"]].set_visible(False)
    panels[0].legend(frameon=False, fontsize=8)
    return [save(figure, experiment.out / "hidden.png")]
