"""Systems near walls: how often constraints are violated, and what keeping them costs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from torch import Tensor

from gpadjust import systems
from gpadjust.control import MPCAgent
from gpadjust.dynamics import Dynamics, LearnedDynamics, PhysicsDynamics
from gpadjust.dynamics.learning import DynamicsFitOptions
from gpadjust.physics import Physics
from gpadjust.states import StateSpec
from gpadjust.systems import System
from gpadjust.systems.swing_up import REAL_CART_POLE, equation_physics
from paper.common.experiment import Run, Table
from paper.common.figures import one_legend, panels, save
from paper.common.tables import frame, groups, of, table
from paper.control import Walls
from paper.control.planners import planners
from paper.control.systems import TANKS

GUST = 0.02  # m/s, standard deviation of what a step adds to the velocity of the cart
GOAL = 0.5  # m


class GustyCart(gym.Env[Any, Any]):
    """A cart of 1.4 kg with dry friction, in gusts."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """At rest, at 0 m."""
        super().reset(seed=seed)
        self.state = np.zeros(2)
        return self.state.copy(), {}

    def step(self, action: Any) -> Any:
        """Push, and be pushed."""
        with torch.no_grad():
            row = torch.tensor([[*self.state, action[0]]], dtype=torch.float64)
            x, v = real_cart(row)[0].tolist()
        gust = GUST * self.np_random.normal()
        self.state = np.array([x + 0.1 * gust, v + gust])
        return self.state.copy(), -abs(self.state[0] - GOAL), False, False, {}


def real_cart(rows: Tensor) -> Tensor:
    """The next state without a gust."""
    x, v, force = rows.unbind(-1)
    v = v + 0.1 * (force - 0.3 * torch.tanh(v / 0.05)) / 1.4
    return torch.stack([x + 0.1 * v, v], dim=-1)


def believed_cart(rows: Tensor) -> Tensor:
    """The next state of a cart of 1 kg without friction."""
    x, v, force = rows.unbind(-1)
    v = v + 0.1 * force
    return torch.stack([x + 0.1 * v, v], dim=-1)


def cart_reward(states: Tensor, actions: Tensor, next_states: Tensor) -> Tensor:
    """By the distance from the goal, in m."""
    return -(next_states[:, 0] - GOAL).abs()


def below(column: int, most: float, states: Tensor, actions: Tensor) -> Tensor:
    """A wall: a state is at most so large."""
    return states[:, [column]] - most


def within(column: int, most: float, states: Tensor, actions: Tensor) -> Tensor:
    """Two walls: a state is at most so far from 0."""
    return torch.stack([states[:, column] - most, -most - states[:, column]], dim=-1)


@dataclass(frozen=True)
class Walled:
    """A system with walls, and the true model of it."""

    system: System
    truth: Physics | Callable[[Tensor], Tensor]


def cart(seed: int) -> Walled:
    """The cart of the guide in gusts, whose goal is 2 cm before a wall."""
    system = System(
        GustyCart,
        StateSpec(["x", "v"], ["force"], step=0.1),
        believed_cart,
        cart_reward,
        episode_length=20,
        constraints=partial(below, 0, 0.52),
        physics_error={"x": 0.003, "v": 0.03},
    )
    return Walled(system, real_cart)


def cart_pole(seed: int) -> Walled:
    """The library's cart-pole on a track of 1 m."""
    errors = {"x": 0.01, "theta": 0.03, "x_dot": 0.15, "theta_dot": 0.25}
    system = systems.cart_pole(seed)
    system = replace(system, constraints=partial(within, 0, 0.5), physics_error=errors)
    return Walled(system, equation_physics(REAL_CART_POLE))


def two_tanks(seed: int) -> Walled:
    """The two tanks, of which the upper one has a brim at 6 cm."""
    errors = {"upper": 0.6, "lower": 0.1}
    machine = replace(TANKS, substeps=4)  # they do not flow over
    system = replace(machine.system(), constraints=partial(below, 0, 6.0), physics_error=errors)
    return Walled(system, machine.physics("true"))


SYSTEMS: dict[str, Callable[[int], Walled]] = {
    "cart": cart,
    "cart-pole": cart_pole,
    "tanks": two_tanks,
}
"""Makes each system, whose f_p a seed may decide."""


def run(experiment: Walls, system: str, controller: str, seed: int) -> Run:
    """Trials of a controller: their costs, and how far they came beyond a wall at most."""
    settings = experiment.settings
    walled = SYSTEMS[system](seed)
    here = walled.system
    real = here.constraints
    changes: dict[str, dict[str, Any]] = {
        "margin": {"probability": settings.probability},
        "none": {"constraints": None},
    }
    here = replace(here, **changes.get(controller, {"probability": None}))
    dynamics: Dynamics = PhysicsDynamics(here.spec, walled.truth)
    if controller != "truth":
        fit: DynamicsFitOptions = {"method": settings.fit}
        error = here.physics_error
        dynamics = LearnedDynamics(here.spec, here.physics, fit_options=fit, physics_error=error)
    plans = planners(settings, settings.horizon * (here.spec.step or 1.0))
    how: dict[str, Any] = {"score_horizons": (), "seed": seed}
    agent = MPCAgent(here.make(), here.task(dynamics), **plans, **how)
    length = here.episode_length or 1
    agent.learn(settings.trials * length)
    made = agent.recorded_episodes()
    assert real is not None, "each system has walls"
    beyond = real(made.next_states, made.actions).amax(-1).unflatten(0, (-1, length))
    return {
        "trials": {
            "cost": (-made.rewards).unflatten(0, (-1, length)).mean(1).tolist(),
            "beyond": beyond.amax(1).tolist(),
        },
        "paths": [[round(x, 4) for x in path.tolist()] for path in beyond],
    }


def tables(runs: Sequence[Run], experiment: Walls) -> dict[str, Table]:
    """The share of trials that violate constraints, and the cost of the others' systems."""
    trials = frame([{k: v for k, v in each.items() if k != "paths"} for each in runs], "trials")
    trials["violated"] = trials["beyond"] > 0
    best = trials[trials.controller == "truth"].groupby(["system", "seed", "episode"]).cost.mean()
    trials = trials.join(best.rename("best"), on=["system", "seed", "episode"])
    labels = {
        (system, controller): f"{name}: {label}"
        for system, name in experiment.axes["system"].items()
        for controller, label in experiment.axes["controller"].items()
    }
    rows = groups(trials, ["system", "controller"], labels)
    rows |= groups(
        trials, "controller", {k: f"all: {v}" for k, v in experiment.axes["controller"].items()}
    )

    def share(part: pd.DataFrame) -> str:
        return f"{part.violated.sum()} of {len(part)}"

    def ratio(part: pd.DataFrame) -> str:
        """Of the costs of all trials of a seed to those of the true model, and its error."""
        pairs = part.groupby(["system", "seed"])[["cost", "best"]].sum(min_count=1).dropna()
        if pairs.empty:
            return ""
        logs = np.log(pairs.cost / pairs.best)
        mean = np.exp(logs.mean())
        error = mean * logs.std() / len(logs) ** 0.5
        return f"{mean:.2f} ± {error:.2f}" if len(logs) > 1 else f"{mean:.2f}"

    def later(cell: Callable[[pd.DataFrame], Any]) -> Callable[[pd.DataFrame], Any]:
        return lambda part: cell(part[part.episode > 1])

    columns = {
        "trial 1 beyond a wall": lambda part: share(part[part.episode == 1]),
        "trials 2 to 5 beyond": later(share),
        "at most by, in the unit of the state": later(of("beyond", "max")),
        "cost / true model's, trial 1": lambda part: ratio(part[part.episode == 1]),
        "trials 2 to 5": later(ratio),
    }
    return {"walls": Table("Walls", table(rows, columns))}


def draw(runs: Sequence[Run], experiment: Walls) -> list[Path]:
    """Draw the distance from the nearest wall in all trials but the first, by controller."""
    names = experiment.axes["system"]
    found = [name for name in names if any(each["system"] == name for each in runs)]
    figure, axes = panels([names[name] for name in found], 3, (3.6, 2.6), share=False)
    for ax, name in zip(axes, found, strict=True):
        for controller, (color, label) in _DRAWN.items():
            own = [r for r in runs if r["system"] == name and r["controller"] == controller]
            paths = np.array([path for each in own for path in each["paths"][1:]])
            for i, path in enumerate(paths):
                last = np.arange(1, len(path) + 1)
                ax.plot(last, path, color=color, lw=0.6, alpha=0.5, label=None if i else label)
        ax.axhline(0.0, color="black", lw=1.2)
        ax.set_ylim(*_SEEN[name])
        ax.set_xlabel("step")
    axes[0].set_ylabel("beyond the nearest wall")
    one_legend(figure, axes)
    return [save(figure, experiment.out / "walls.png")]


_DRAWN = {
    "margin": ("tab:blue", "margins, probability 0.95"),
    "hard": ("tab:red", "constraints in the mean, no margin"),
}
_SEEN = {"cart": (-0.1, 0.04), "cart-pole": (-0.6, 0.15), "tanks": (-3.0, 0.6)}
