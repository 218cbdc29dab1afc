"""The runs of this experiment."""

from __future__ import annotations

from functools import partial
from typing import Any

from gpadjust.envs import random_cart_pole_physics
from gpadjust.rl import DynaSAC
from paper.cartpole.recorder import CartPoleRecorder
from paper.cartpole.scenarios import SCENARIOS, SETTINGS, functions, make_dynamics, make_env
from paper.control import runs
from paper.control.experiment import Experiment


def details(agent: DynaSAC, seed: int) -> dict[str, Any]:
    """The parameters of f_p, which are random."""
    return {"physics": vars(random_cart_pole_physics(seed).rhs)}


CART_POLE = Experiment(
    name="cartpole",
    scenarios=SCENARIOS,
    settings=SETTINGS,
    make_env=make_env,
    make_dynamics=make_dynamics,
    functions=functions,
    make_recorder=CartPoleRecorder,
    details=details,
)
make_agent = CART_POLE.make_agent
run_one = partial(runs.run_one, CART_POLE)
run_all = partial(runs.run_all, CART_POLE)
make_tasks = partial(runs.make_tasks, CART_POLE)
