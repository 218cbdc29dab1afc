"""Makes the trials that all models are tested on: ``python -m paper.exploration.make_held_out``."""

from __future__ import annotations

import pandas as pd
import torch
from torch import Tensor

from gpadjust.dynamics import Dynamics
from gpadjust.envs import cart_pole_cost, cart_pole_start
from gpadjust.envs.cart_pole_swing_up import MAX_FORCE
from gpadjust.models.sampled_functions import seeded
from gpadjust.rl.action_sequences import cross_entropy, random_sequences
from paper.cartpole.scenarios import true_dynamics
from paper.exploration.held_out import (
    ACTIONS,
    FOLLOWING,
    KINDS,
    NUM_STARTS,
    NUM_STEPS,
    PATH,
    STATES,
)

SEED = 20_000  # no run has it
_MAX_HOLD = 5


def make_trials(
    num_starts: int = NUM_STARTS, rounds: int = 20, num_sequences: int = 100
) -> pd.DataFrame:
    """Make trials of the real system from some starts, a swing-up and a random one from each.

    The actions of a swing-up are the open loop that the cross-entropy method finds for the known
    system; those of a random trial are uniform, each held for up to 5 steps.
    """
    real = true_dynamics(encode_angle=True)
    bounds = torch.tensor([[-MAX_FORCE], [MAX_FORCE]], dtype=torch.float64)
    tables = []
    with seeded(SEED):
        for start in cart_pole_start(num_starts):

            def gain(sequences: Tensor, start: Tensor = start) -> Tensor:
                return -cart_pole_cost(_path(real, start, sequences)[:, 1:]).mean(-1)

            first = random_sequences(num_sequences, NUM_STEPS, bounds, _MAX_HOLD)
            best, _ = cross_entropy(gain, first, bounds, rounds, num_elites=10)
            wild = random_sequences(1, NUM_STEPS, bounds, _MAX_HOLD)[0]
            tables += [
                _table(kind, _path(real, start, actions.unsqueeze(0))[0], actions)
                for kind, actions in zip(KINDS, (best, wild), strict=True)
            ]
    return pd.concat(tables)


def _path(real: Dynamics, start: Tensor, sequences: Tensor) -> Tensor:
    """The states of trials, ``n x (T + 1) x 4``."""
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
    made = make_trials()
    made.to_csv(PATH, index=False, float_format="%.9g")
    following = torch.tensor(made[FOLLOWING].to_numpy(dtype=float))
    cost = cart_pole_cost(following).reshape(-1, NUM_STEPS).mean(1)
    print(f"mean costs of the trials: {[round(c, 3) for c in cost.tolist()]}")
