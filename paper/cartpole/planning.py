"""Trials of a cart-pole, each planned in what is known of it by then."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpadjust.control import MPCAgent, Planner
from gpadjust.core import SamplingWarning
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.physics import Unknown
from gpadjust.systems import NoisySensors, System, cart_pole
from gpadjust.systems.swing_up import (
    CART_POLE_SPEC,
    REAL_CART_POLE,
    START_MEAN,
    believed_cart_pole,
    cart_pole_spec,
    equation_physics,
)
from paper.cartpole import (
    FRICTIONS,
    SENSORS,
    SMALL_NOISE,
    CartPole,
    Planning,
)
from paper.common.experiment import Run, Table
from paper.common.figures import curves as draw_curves
from paper.common.learners import LEARNERS
from paper.common.runner import runs_file
from paper.common.tables import frame, groups, markdown, number, of, table
from paper.common.verdicts import Curves

FRICTION_UNKNOWNS = {
    "dry": Unknown(0.2, bounds=(0.0, 2.0), unit="N"),
    "drag": Unknown(0.005, bounds=(0.0, 0.1), unit="N m s²/rad²"),
}
"""The terms that f_p lacks on the systems with friction, for the baseline that is told of them."""

_LEARNERS, _SYSTEMS = Planning.axes["learner"], Planning.axes["system"]


def run(experiment: Planning, system: str, learner: str, seed: int) -> Run:
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
        late = np.stack(agent.env.get_wrapper_attr("episodes")[len(rows)])[
            -round(1 / settings.time_step) :
        ]
        seconds = {name: agent.wall_time[name] - before[name] for name in ("plan", "fit")}
        rows.append(
            {
                "cost": costs.mean().item(),
                "last_cost": costs[-5:].mean().item(),
                "last_offset": np.abs(late[:, 0]).max().item(),
                "last_lean": np.abs(np.degrees(wrapped(late[:, 1]))).max().item(),
                **{f"{name}_seconds": spent for name, spent in seconds.items()},
                "cpu_seconds": time.process_time() - start,
            }
        )
    return {"trials": {name: [row[name] for row in rows] for name in rows[0]}}


def make_agent(experiment: Planning, system: str, learner: str, seed: int) -> MPCAgent:
    """The agent of a run, at its start."""
    settings = experiment.settings_of(system)
    env, length = environment(system, settings), settings.episode_length
    each_step, first = planners(settings)
    task = system_of(system, settings).task(dynamics(settings, system, learner, seed))
    if system == "mc-pilco":
        task = replace(task, reward=mc_pilco_reward)
    common: dict[str, Any] = {
        "reward_tolerance": None,
        "score_horizons": (),
        "random_steps": settings.random_trials * length,
        "seed": seed,
    }
    return MPCAgent(env, task, each_step, first=first, **common)


def planners(settings: Planning) -> tuple[Planner, Planner]:
    """The planner of each step, and that of a trial that begins."""
    search: dict[str, Any] = {"num_elites": settings.elites, "correlation": settings.correlation}
    each_step = Planner(
        rounds=settings.rounds,
        **search,
        horizon=settings.horizon * settings.time_step,
        num_random=settings.sequences,
        spread=settings.spread,
    )
    first = Planner(rounds=settings.first_rounds, **search, num_random=settings.first_sequences)
    return each_step, first


def system_of(name: str, settings: Planning, seed: int = 0, **options: Any) -> System:
    """A cart-pole, and what is known of it."""
    dry, drag = FRICTIONS.get(name, (0.0, 0.0))
    given: dict[str, Any] = {"time_step": settings.time_step, **options}
    return cart_pole(seed, dry=dry, drag=drag, episode_length=settings.episode_length, **given)


def dynamics(settings: Planning, system: str, learner: str, seed: int) -> Dynamics:
    """The model that is planned in, at its start."""
    if learner == "oracle":
        dry, drag = FRICTIONS.get(system, (0.0, 0.0))
        real = replace(REAL_CART_POLE, dry=dry, drag=drag)
        spec = cart_pole_spec(time_step=settings.time_step)
        return PhysicsDynamics(spec, equation_physics(real, settings.time_step))
    known = system_of(system, settings, seed, unknowns=learner in ("fitted", "structured"))
    if learner == "structured":
        unknowns = {**known.unknowns, **FRICTION_UNKNOWNS}
        physics = equation_physics(believed_cart_pole(seed), settings.time_step, unknowns)
        return PhysicsDynamics(known.spec, physics)
    if learner in ("phy", "fitted"):
        return PhysicsDynamics(known.spec, known.physics)
    made = LEARNERS[learner]
    return LearnedDynamics(known.spec, known.physics if made.adjusts else None, model=made.make)


def wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in [-pi, pi)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


class Still(gym.Wrapper[Any, Any, Any, Any]):
    """Episodes of the cart-pole that start nearly still."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Start from about the hanging pole at rest."""
        self.env.reset(seed=seed)
        start = self.unwrapped.np_random.normal(START_MEAN, SMALL_NOISE)
        return self.env.reset(options={"state": start})


class Watched(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps the true states of an episode.

    Attributes:
        episodes: Those of each episode, ``T x 4``, the newest last.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.episodes: list[list[NDArray[np.float64]]] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        self.episodes.append([])
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """Make a step."""
        result = self.env.step(action)
        unwrapped: Any = self.unwrapped
        self.episodes[-1].append(unwrapped.state)
        return result


def environment(system: str, settings: Planning) -> Watched:
    """The real system."""
    env: gym.Env[Any, Any] = system_of(system, settings).make()
    if system == "sensors":
        env = NoisySensors(env, CART_POLE_SPEC, SENSORS)
    elif system == "mc-pilco":
        small = dict.fromkeys(CART_POLE_SPEC.states, SMALL_NOISE)
        env = NoisySensors(Still(env), CART_POLE_SPEC, small)
    return Watched(env)


def mc_pilco_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """The reward of that protocol, of transitions ``N x ...``: how far pole and cart are off.

    That of the others is of the tip alone, under which the cart may swing.
    """
    x, theta = next_states[:, 0], next_states[:, 1]
    lean = torch.atan2(theta.sin(), theta.cos())
    return torch.expm1(-(lean / 3).square() - x.square())


def tables(runs: Sequence[Run], experiment: Planning) -> dict[str, Table]:
    """All tables, by name."""
    trials, last = frame(runs, "trials"), experiment.trials
    by_system = {system: trials[trials["system"] == system] for system in _SYSTEMS}
    found = {}
    for system, own in by_system.items():
        if len(own):
            text = _successes(own) if system == "mc-pilco" else _costs(own, last)
            if system == "plain":
                text = f"{text}\n{_of_dyna(experiment, last)}".rstrip()
            found[str(system)] = Table(f"Cart-pole {_SYSTEMS[system]}", text)
    found["short"] = Table("Mean cost of planned trials", _short(trials, last))
    seconds = {"plan_seconds": "plans, s", "fit_seconds": "fit, s", "cpu_seconds": "CPU, s"}
    columns = {what: of(column, "median", ".1f") for column, what in seconds.items()}
    text = table(groups(trials, "learner", _LEARNERS), columns, "median of a trial")
    found["seconds"] = Table("Seconds of a trial", text)
    return found


def _short(trials: pd.DataFrame, last: int) -> str:
    """Each learner beside CKA, by the seeds that both have."""
    systems = groups(trials[trials["system"] != "mc-pilco"], "system", _SYSTEMS)
    rows = []
    for learner, label in _LEARNERS.items():
        cells = []
        for own in systems.values():
            curves = Curves(own, "cost")
            if learner == "cka":
                cost = number(curves.window("cka", 2, last).mean(), ".2f")
                cells.append(f"{cost} ({len(curves.seeds('cka'))} runs)")
            else:
                gap = curves.paired_difference(learner, 2, last)
                cells.append(f"{gap.text('.2f')} ({gap.n})" if gap.n else "")
        if any(cells):
            rows.append([label if learner == "cka" else f"{label}, less CKA's", *cells])
    return markdown(["mean cost of trials 2-5", *systems], rows)


def _of_dyna(experiment: Planning, last: int) -> str:
    """Rows of the learners of the cart-pole's own experiment that have a model, if it was run."""
    other = CartPole(out=experiment.out)
    runs, rows = runs_file(other).read().values(), []
    for name in ("cka", "phy", "gp"):
        costs = np.array([r["episodes"]["cost"] for r in runs if r["scenario"] == name])
        if len(costs):
            cells = [number(each, ".3f") for each in costs[:, :last].mean(0)]
            worst = number(costs[:, 2:last].max(), ".3f")
            rows.append([f"DynaSAC, {_LEARNERS[name]}", f"{len(costs)}", *cells, worst, ""])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def succeeded(trials: pd.DataFrame) -> pd.Series[bool]:
    """Trials whose pole and cart stay within 10 degrees and 0.1 m of the goal for a second."""
    return (trials["last_lean"] <= 10) & (trials["last_offset"] <= 0.1)


def _successes(own: pd.DataFrame) -> str:
    """The number of runs of which each trial succeeds, but the first, which is random."""
    own = own.assign(success=succeeded(own), episode=own["episode"] - 1)
    own = own[own["episode"] >= 1]
    columns: dict[str, Any] = {"runs": lambda part: part["seed"].nunique()}
    for trial in range(1, own["episode"].max() + 1):
        columns[f"trial {trial}"] = partial(_successes_at, trial)
    columns["mean cost of these"] = of("cost", form=".3f")
    return table(groups(own, "learner", _LEARNERS), columns)


def _successes_at(trial: int, part: pd.DataFrame) -> int:
    return int(part.loc[part["episode"] == trial, "success"].sum())


def _costs(own: pd.DataFrame, last: int) -> str:
    return trials_table(own, "cost", _LEARNERS, range(1, last + 1), (3, 5), (2, last), ".3f")


def trials_table(
    own: pd.DataFrame, measure: str, labels: Mapping[Any, str], shown: Sequence[int],
    late: tuple[int, int], compared: tuple[int, int], form: str,
) -> str:  # fmt: skip
    """Means of some trials, the worst of later ones, differences from CKA by the same seeds."""
    curves = Curves(own, measure)

    def gap(part: pd.DataFrame) -> str:
        if "cka" not in curves.names:
            return ""
        return curves.paired_difference(part["learner"].iloc[0], *compared).text(form)

    def mean_at(trial: int, part: pd.DataFrame) -> str:
        return number(curves.mean_at(part["learner"].iloc[0], trial), form)

    columns: dict[str, Any] = {"runs": lambda part: part["seed"].nunique()}
    columns |= {f"trial {i}": partial(mean_at, i) for i in shown}
    columns["worst of {}-{}".format(*late)] = lambda part: number(
        part.loc[part["episode"].between(*late), measure].max(), form
    )
    return table(groups(own, "learner", labels), {**columns, "less CKA's": gap})


def draw(runs: Sequence[Run], experiment: Planning) -> list[Path]:
    """Draw the cost of the trials, models over each other, a panel for each system."""
    trials = frame(runs, "trials")
    parts = {
        f"{label} ({own['seed'].nunique()} runs)": own
        for label, own in groups(trials, "system", _SYSTEMS).items()
    }
    colors = {name: known.color for name, known in LEARNERS.items()} | {"structured": "tab:olive"}
    lines = {name: (label, colors[name]) for name, label in _LEARNERS.items()}
    labels = ("trial", "cost, mean ± standard deviation")
    path = experiment.folder / "planning.png"
    return [draw_curves(path, parts, "cost", lines, labels=labels, share=False)]
