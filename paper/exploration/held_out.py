"""Transitions of the real system that all models are tested on; they are the same for all runs.

``paper/exploration/make_held_out.py`` makes them.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pandas as pd
import torch

from gpadjust.dynamics import Dynamics
from gpadjust.dynamics.transitions import Transitions
from gpadjust.envs import CART_POLE_SPEC

PATH = Path(__file__).with_name("held_out.csv")
KINDS = ("swing-up", "random")
NUM_STARTS = 10
NUM_STEPS = 25
STATES = list(CART_POLE_SPEC.states)
ACTIONS = list(CART_POLE_SPEC.actions)
FOLLOWING = [f"next_{name}" for name in STATES]


@cache
def held_out() -> dict[str, Transitions]:
    """The transitions of the 10 trials of each of ``KINDS``."""
    table = pd.read_csv(PATH)
    parts = (STATES, ACTIONS, FOLLOWING)
    return {
        kind: Transitions(*(torch.tensor(rows[part].to_numpy(dtype=float)) for part in parts))
        for kind, rows in table.groupby("trial")
    }


def errors(dynamics: Dynamics) -> dict[str, float]:
    """The error of the next states that dynamics predict, for each kind of trial.

    The root of the mean square over transitions and states, each state in units of the root mean
    square of its change in the trials of that kind; to predict no change at all has an error of 1.
    """
    found = {}
    for kind, data in held_out().items():
        mean, _ = dynamics.predict(data.states, data.actions)
        error = dynamics.spec.change(mean, data.next_states)
        scale = dynamics.spec.change(data.states, data.next_states).square().mean(0)
        found[kind] = float((error.square().mean(0) / scale).mean().sqrt())
    return found
