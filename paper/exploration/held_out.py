"""Transitions of the real system that all models are tested on; they are the same for all runs.

``python -m paper.exploration.held_out`` makes them.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from gpadjust.control import CrossEntropy, Information, Planner
from gpadjust.control.search import random_sequences
from gpadjust.dynamics import Dynamics, PhysicsDynamics
from gpadjust.dynamics.transitions import Transitions
from gpadjust.envs import CART_POLE_SPEC, cart_pole_cost, cart_pole_start
from gpadjust.envs.cart_pole.swing_up import MAX_FORCE
from gpadjust.models.sampled_functions import seeded
from paper.cartpole import system as cartpole
from paper.control import Scenario
from paper.control.learner import System
from paper.exploration import PLANS, Settings

PATH = Path(__file__).with_name("held_out.csv")
KINDS = ("swing-up", "random")
NUM_STARTS = 10
NUM_STEPS = 25
SEED = 20_000  # no run has it
STATES = list(CART_POLE_SPEC.states)
ACTIONS = list(CART_POLE_SPEC.actions)
FOLLOWING = [f"next_{name}" for name in STATES]
_MAX_HOLD = 5


def system(scenario: Scenario, settings: Settings, seed: int) -> System:
    """A run's cart-pole, its task and recorder, and who plans its episodes."""
    found = cartpole.system(scenario, settings, seed)
    recorder = ExplorationRecorder(settings, scenario.model is None, seed)
    plan: dict[str, Any] = {name: getattr(settings, name) for name in PLANS}
    num_planned = plan.pop("explore_episodes")
    search = CrossEntropy(plan.pop("rounds"), num_elites=plan.pop("num_elites"))
    planner = Planner(Information(), search, **plan) if num_planned else None
    return System(found.env, found.task, recorder, planner, num_planned)


class ExplorationRecorder(cartpole.CartPoleRecorder):
    """Records also how well the newest model predicts the held-out episodes."""

    def of_policy(self, episode: int) -> dict[str, Any]:
        """The deterministic policy's cost, and the errors of the newest model."""
        task = self.model.task
        found = {} if task is None else errors(task.dynamics)
        return {
            **super().of_policy(episode),
            "error": found["swing-up"],
            "error_random": found["random"],
        }


@cache
def held_out() -> dict[str, Transitions]:
    """The transitions of the 10 episodes of each of ``KINDS``."""
    table = pd.read_csv(PATH)
    parts = (STATES, ACTIONS, FOLLOWING)
    return {
        kind: Transitions(*(torch.tensor(rows[part].to_numpy(dtype=float)) for part in parts))
        for kind, rows in table.groupby("trial")
    }


def errors(dynamics: Dynamics) -> dict[str, float]:
    """The error of the next states that dynamics predict, for each kind of episode.

    The root of the mean square over transitions and states, each state in units of the root mean
    square of its change in the episodes of that kind; to predict no change has an error of 1.
    """
    found = {}
    for kind, data in held_out().items():
        mean, _ = dynamics.predict(data.states, data.actions)
        error = dynamics.spec.change(mean, data.next_states)
        scale = dynamics.spec.change(data.states, data.next_states).square().mean(0)
        found[kind] = float((error.square().mean(0) / scale).mean().sqrt())
    return found


def make(num_starts: int = NUM_STARTS, rounds: int = 20, num_sequences: int = 100) -> pd.DataFrame:
    """Make episodes of the real system from some starts, a swing-up and a random one from each.

    The actions of a swing-up are the open loop that the cross-entropy method finds for the known
    system; those of a random episode are uniform, each held for up to 5 steps.
    """
    real = PhysicsDynamics(CART_POLE_SPEC, cartpole.true_physics())
    bounds = torch.tensor([[-MAX_FORCE], [MAX_FORCE]], dtype=torch.float64)
    tables = []
    with seeded(SEED):
        for start in cart_pole_start(num_starts):

            def gain(sequences: Tensor, start: Tensor = start) -> Tensor:
                return -cart_pole_cost(_path(real, start, sequences)[:, 1:]).mean(-1)

            first = random_sequences(num_sequences, NUM_STEPS, bounds, _MAX_HOLD)
            best, _ = CrossEntropy(rounds, num_elites=10).best(gain, first, bounds)
            wild = random_sequences(1, NUM_STEPS, bounds, _MAX_HOLD)[0]
            tables += [
                _table(kind, _path(real, start, actions.unsqueeze(0))[0], actions)
                for kind, actions in zip(KINDS, (best, wild), strict=True)
            ]
    return pd.concat(tables)


def _path(real: Dynamics, start: Tensor, sequences: Tensor) -> Tensor:
    """The states of episodes, ``n x (T + 1) x 4``."""
    states = [start.expand(len(sequences), -1)]
    for actions in sequences.unbind(1):
        states.append(real.sample(states[-1], actions))
    return torch.stack(states, dim=1)


def _table(kind: str, path: Tensor, actions: Tensor) -> pd.DataFrame:
    rows = torch.cat([path[:-1], actions, path[1:]], dim=-1)
    table = pd.DataFrame(rows.numpy(), columns=[*STATES, *ACTIONS, *FOLLOWING])
    table.insert(0, "trial", kind)
    return table


if __name__ == "__main__":
    made = make()
    made.to_csv(PATH, index=False, float_format="%.9g")
    following = torch.tensor(made[FOLLOWING].to_numpy(dtype=float))
    cost = cart_pole_cost(following).reshape(-1, NUM_STEPS).mean(1)
    print(f"mean costs of the episodes: {[round(c, 3) for c in cost.tolist()]}")
